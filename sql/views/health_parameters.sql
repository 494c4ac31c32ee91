-- How is each pack now, after each flight?
-- A row uses its flight and those before it. Parameters that end in _smoothed do not: they also know the 50 to 100
-- flights after, change while they come in, and are for looking back; decide by those without.
-- is_observed: the flight moved the estimate; else it is what the flights before say, the prior, or nothing
-- departed_on: day of departure in UTC; departed_at::date is a day of the session's time zone
-- Grain: flight, pack, parameter. Reads: tables.twin_health.
create or replace view health_parameters as
select
    *,
    value is not null and status not in ('predicted', 'prior_only') as is_observed,
    (departed_at at time zone 'UTC')::date as departed_on
from tables.twin_health;
