-- Of which units is the loss not known tonight: nothing was observed beyond the prior, or work has renewed them since?
-- work_action: CLEANED or REPLACED, where that was done since the aircraft last flew
-- work_on: day of that work
-- Grain: operator, tail, pack, component. Reads: unobserved_units, renewed_units.
create or replace view unestimated_units as
with units as (
    select
        operator,
        tail,
        pack,
        component,
        null as work_action,
        null as work_on
    from unobserved_units
    where counts_to is null
    union all
    select
        operator,
        tail,
        pack,
        component,
        work_action,
        work_on
    from renewed_units
)

select
    operator,
    tail,
    pack,
    component,
    max(work_action) as work_action,
    max(work_on) as work_on
from units
group by operator, tail, pack, component;
