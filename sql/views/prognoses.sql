-- How long is left, and how sure?
-- departed_on: day of departure in UTC; departed_at::date is a day of the session's time zone
-- Grain: flight, pack, component. Reads: tables.prognoses.
create or replace view prognoses as
select
    *,
    (departed_at at time zone 'UTC')::date as departed_on
from tables.prognoses;
