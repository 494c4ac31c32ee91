-- Which flights say something of a declared component, and why not the others?
-- departed_on: day of departure in UTC; departed_at::date is a day of the session's time zone
-- Grain: flight, pack, component. Reads: tables.legs_components.
create or replace view component_legs as
select
    *,
    (departed_at at time zone 'UTC')::date as departed_on
from tables.legs_components;
