-- How long is left, and how sure?
-- departed_on: day of departure in UTC; departed_at::date is a day of the session's time zone
-- Grain: flight, pack, component. Reads: tables.prognoses, tables.prognoses_components.
create or replace view prognoses as
with outlook as (
    select * from tables.prognoses
    union all by name
    select * from tables.prognoses_components
)

select
    *,
    (departed_at at time zone 'UTC')::date as departed_on
from outlook;
