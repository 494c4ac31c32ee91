-- How is each pack now, after each flight?
-- A row uses its flight and those before it. Parameters that end in _smoothed do not: they also know the 50 to 100
-- flights after, change while they come in, and are for looking back; decide by those without.
-- is_observed: the flight moved the estimate; else it is what the flights before say, the prior, or nothing
-- departed_on: day of departure in UTC; departed_at::date is a day of the session's time zone
-- Grain: flight, pack, parameter. Reads: tables.twin_health, airframes.
create or replace view health_parameters as
select
    o.*,
    o.value is not null and o.status not in ('predicted', 'prior_only') as is_observed,
    (o.departed_at at time zone 'UTC')::date as departed_on,
    n.msn
from tables.twin_health as o
left join airframes as n on o.operator = n.operator and o.tail = n.tail;
