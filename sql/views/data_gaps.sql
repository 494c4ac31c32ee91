-- Which flights never arrived, and which aircraft fell silent?
-- A flight that is held, or of which a file or row is in quarantine, has arrived.
-- gap: missing_leg (a leg number of a day was skipped), silence (ten times the aircraft's usual wait, and three days),
-- silent_now (the same, up to the fleet's last flight), never_heard (on the fleet list only).
-- from_at: landing of the flight before the gap
-- until_at: departure of the flight after it, or of the fleet's last flight
-- after_flight_id: flight before the gap
-- n_flights: leg numbers skipped
-- silent_days: length of the silence [days]
-- Grain: operator, tail, gap, from_at. Reads: flights, held_flights, quarantine, tables.raw_fleet.
create or replace view data_gaps as
with ordered as (
    select
        operator,
        tail,
        flight_id,
        departed_at,
        coalesce(landed_at, departed_at) as landed_at,
        flight_id[-11:-4] as flight_day,
        flight_id[-2:]::int as leg,
        lead(flight_id) over own as next_flight_id,
        lead(departed_at) over own as next_at,
        max(departed_at) over () as fleet_last_at
    from flights
    window own as (partition by operator, tail order by departed_at asc, flight_id asc)
),

usual as (
    select
        operator,
        tail,
        median(epoch(next_at) - epoch(landed_at)) as wait_s
    from ordered
    where next_at is not null
    group by operator, tail
),

arrived as (
    select
        operator,
        tail,
        flight_id
    from flights
    union
    select
        operator,
        tail,
        flight_id
    from held_flights
    union
    select
        operator,
        tail,
        coalesce(flight_id, regexp_extract(file, '[^/]+_[0-9]{8}_[0-9]{2}')) as flight_id
    from quarantine
    where scope != 'note'
),

legs_arrived as (
    select
        operator,
        tail,
        flight_id[-11:-4] as flight_day,
        try_cast(flight_id[-2:] as int) as leg
    from arrived
    where length(flight_id) > 11
),

waits as (
    select
        o.operator,
        o.tail,
        o.flight_id,
        o.landed_at,
        o.next_at,
        o.fleet_last_at,
        case when o.next_flight_id[-11:-4] = o.flight_day then o.leg else 0 end as legs_before,
        o.next_flight_id[-11:-4] as next_day,
        o.next_flight_id[-2:]::int as next_leg,
        epoch(coalesce(o.next_at, o.fleet_last_at)) - epoch(o.landed_at) as silent_s,
        greatest(10 * coalesce(u.wait_s, 0), 3 * 86400) as allowed_s
    from ordered as o
    left join usual as u on o.operator = u.operator and o.tail = u.tail
),

skipped as (
    select
        w.operator,
        w.tail,
        w.landed_at,
        w.next_at,
        w.flight_id,
        w.next_leg - w.legs_before - 1 - count(distinct a.leg) as n_flights
    from waits as w
    left join legs_arrived as a
        on
            w.operator = a.operator
            and w.tail = a.tail
            and w.next_day = a.flight_day
            and w.legs_before < a.leg
            and w.next_leg > a.leg
    where w.next_leg > w.legs_before + 1
    group by w.operator, w.tail, w.landed_at, w.next_at, w.flight_id, w.next_leg, w.legs_before
)

select
    operator,
    tail,
    'missing_leg' as gap,
    landed_at as from_at,
    next_at as until_at,
    flight_id as after_flight_id,
    n_flights::bigint as n_flights,
    null::double as silent_days
from skipped
where n_flights > 0
union all
select
    operator,
    tail,
    case when next_at is null then 'silent_now' else 'silence' end as gap,
    landed_at as from_at,
    coalesce(next_at, fleet_last_at) as until_at,
    flight_id as after_flight_id,
    null::bigint as n_flights,
    silent_s / 86400 as silent_days
from waits
where silent_s > allowed_s
union all
select
    f.operator,
    f.tail,
    'never_heard' as gap,
    null::timestamptz as from_at,
    null::timestamptz as until_at,
    null::varchar as after_flight_id,
    null::bigint as n_flights,
    null::double as silent_days
from tables.raw_fleet as f
anti join flights as k
    on
        coalesce(f.airframe_operator, f.operator) = k.operator
        and coalesce(f.airframe_tail, f.tail) = k.tail;
