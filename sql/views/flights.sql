-- Which flights arrived, and what of them?
-- departed_on: day of departure in UTC; departed_at::date is a day of the session's time zone
-- Grain: flight. Reads: tables.raw_flights, tables.legs_verdicts.
create or replace view flights as
with verdicts as (
    select
        operator,
        flight_id,
        max(cruise_minutes) as cruise_minutes
    from tables.legs_verdicts
    group by operator, flight_id
)

select
    f.operator,
    f.tail,
    f.flight_id,
    f.departed_at,
    f.landed_at,
    f.source,
    f.n_snapshots,
    coalesce(v.cruise_minutes, 0) as cruise_minutes,
    f.n_seconds,
    f.origin,
    f.destination,
    (f.departed_at at time zone 'UTC')::date as departed_on
from tables.raw_flights as f
left join verdicts as v on f.operator = v.operator and f.flight_id = v.flight_id;
