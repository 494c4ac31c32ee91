-- When was each unit replaced, washed or adjusted, as the log has it or as the flights show it?
-- flown_from: flights that depart from then on count as flown after it
-- seen_by: log, or flights (a recovery, on the log or not)
-- Grain: operator, tail, pack, component, flown_from, seen_by. Reads: maintenance, recoveries.
create or replace view unit_renewals as
select distinct
    operator,
    tail,
    position as pack,
    component,
    flown_from,
    'log' as seen_by
from maintenance
where in_force and action in ('REPLACED', 'CLEANED', 'ADJUSTED') and position is not null
union all
select
    operator,
    tail,
    pack,
    component,
    fell_at as flown_from,
    'flights' as seen_by
from recoveries;
