-- Which flights arrived and are not held, and what of them?
-- departed_on: day of departure in UTC; departed_at::date is a day of the session's time zone
-- source: acms, cpl or both; component where only a declared component has a record of the flight
-- Grain: flight. Reads: tables.raw_flights, tables.legs_verdicts, tables.raw_components,
-- tables.record_held, airframes.
create or replace view flights as
with verdicts as (
    select
        operator,
        flight_id,
        max(cruise_minutes) as cruise_minutes
    from tables.legs_verdicts
    group by operator, flight_id
),

others as (
    select
        c.operator,
        c.tail,
        c.flight_id,
        min(c.time_utc) as departed_at,
        max(c.time_utc) as landed_at
    from tables.raw_components as c
    anti join tables.raw_flights as f on c.operator = f.operator and c.flight_id = f.flight_id
    group by c.operator, c.tail, c.flight_id
),

all_flights as (
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
    left join verdicts as v on f.operator = v.operator and f.flight_id = v.flight_id
    anti join tables.record_held as h
        on f.operator = h.operator and f.flight_id = h.flight_id and not h.is_used
    union all
    select
        operator,
        tail,
        flight_id,
        departed_at,
        landed_at,
        'component' as source,
        0 as n_snapshots,
        0 as cruise_minutes,
        0 as n_seconds,
        null as origin,
        null as destination,
        (departed_at at time zone 'UTC')::date as departed_on
    from others
)

select
    o.*,
    n.msn
from all_flights as o
left join airframes as n on o.operator = n.operator and o.tail = n.tail;
