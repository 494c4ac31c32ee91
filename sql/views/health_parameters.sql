-- How is each pack now, after each flight?
-- A row uses its flight and those before it. One parameter does not: hx_fouling_smoothed also knows the 50 to 100
-- flights after, changes while they come in, and is for looking back; decide by hx_fouling.
-- departed_on: day of departure in UTC; departed_at::date is a day of the session's time zone
-- Grain: flight, pack, parameter. Reads: tables.twin_health.
create or replace view health_parameters as
select
    *,
    (departed_at at time zone 'UTC')::date as departed_on
from tables.twin_health;
