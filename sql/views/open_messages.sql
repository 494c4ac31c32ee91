-- Which messages on record has nothing answered yet?
-- Answered is a message by work on its component since, by a repair of the ram air door (which raises the exchanger's),
-- by an inspection that found no fault, and by a recovery that the log lacks. One that came on a single flight, with
-- neither loss nor margin in support, lapses after 50 flights without another.
-- message_at: time of the oldest
-- last_message_at: time of the newest
-- n_flights: flights on which it came; a message without a flight is of the last one that departed within a day
-- n_flown: flights since the oldest, its own included
-- flights_ago: flights since the oldest, its own not counted
-- is_supported: an alert of the component is open, or its message is likely by the prognosis (one in ten)
-- is_pressing: it came on two flights or more, or it is supported
-- Grain: operator, tail, pack, component. Reads: tables.raw_messages, tables.raw_maintenance, settled_work,
-- tables.components, flights, unlogged_work, check_chances, alerts.
create or replace view open_messages as
with sent as (
    select
        m.operator,
        m.tail,
        m.pack,
        c.component,
        m.message_time,
        coalesce(
            m.flight_id,
            case when m.message_time < b.departed_at + interval 1 day then b.flight_id end,
            m.message_time::varchar
        ) as flight,
        coalesce(f.departed_at, m.message_time) as departed_at
    from tables.raw_messages as m
    inner join tables.components as c on m.code = c.message_code
    left join flights as f on m.operator = f.operator and m.flight_id = f.flight_id
    asof left join flights as b
        on m.operator = b.operator and m.tail = b.tail and m.message_time >= b.departed_at
    where m.pack is not null
),

ends as (
    select
        operator,
        tail,
        pack,
        component,
        counts_from as ended_at
    from settled_work
    where is_judged or action in ('REPLACED', 'CLEANED') or finding = 'NO_FAULT_FOUND'
    union all
    select
        operator,
        tail,
        pack,
        'HX' as component,
        counts_from as ended_at
    from tables.raw_maintenance
    where component = 'RAM_DOOR' and action in ('REPLACED', 'ADJUSTED')
    union all
    select
        operator,
        tail,
        pack,
        component,
        departed_at as ended_at
    from unlogged_work
),

last_ends as (
    select
        operator,
        tail,
        pack,
        component,
        max(ended_at) as ended_at
    from ends
    group by operator, tail, pack, component
),

unanswered as (
    select
        s.operator,
        s.tail,
        s.pack,
        s.component,
        min(s.message_time) as message_at,
        max(s.message_time) as last_message_at,
        min(s.departed_at) as first_departed_at,
        max(s.departed_at) as last_departed_at,
        count(distinct s.flight) as n_flights
    from sent as s
    left join last_ends as e
        on s.operator = e.operator and s.tail = e.tail and s.pack = e.pack and s.component = e.component
    where e.ended_at is null or s.departed_at >= e.ended_at
    group by s.operator, s.tail, s.pack, s.component
),

counted as (
    select
        u.operator,
        u.tail,
        u.pack,
        u.component,
        count(*) filter (where f.departed_at >= u.first_departed_at) as n_flown,
        count(*) filter (where f.departed_at > u.first_departed_at) as flights_ago,
        count(*) filter (where f.departed_at > u.last_departed_at) as n_since
    from unanswered as u
    inner join flights as f on u.operator = f.operator and u.tail = f.tail
    group by u.operator, u.tail, u.pack, u.component
),

supported as (
    select
        operator,
        tail,
        pack,
        component
    from check_chances
    where is_observed and coalesce(chance, chance_at_least, p_event_50) >= 0.1
    union
    select
        operator,
        tail,
        pack,
        component
    from alerts
    where closed_at is null
),

judged as (
    select
        u.*,
        coalesce(c.n_flown, 0) as n_flown,
        coalesce(c.flights_ago, 0) as flights_ago,
        coalesce(c.n_since, 0) as n_since,
        s.component is not null as is_supported
    from unanswered as u
    left join counted as c
        on u.operator = c.operator and u.tail = c.tail and u.pack = c.pack and u.component = c.component
    left join supported as s
        on u.operator = s.operator and u.tail = s.tail and u.pack = s.pack and u.component = s.component
)

select
    operator,
    tail,
    pack,
    component,
    message_at,
    last_message_at,
    n_flights,
    n_flown,
    flights_ago,
    is_supported,
    n_flights >= 2 or is_supported as is_pressing
from judged
where n_flights >= 2 or is_supported or n_since < 50;
