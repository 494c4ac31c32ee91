-- How many flights a day does each aircraft fly, and what does that rest on?
-- The median of its last six whole weeks on record, counted back from its last flight: a week on the ground, or one
-- whose files are late, moves it little.
-- last_departed_at: departure of its last flight
-- flights_per_day: NULL where the record is shorter than a week, or half of the weeks have no flight
-- n_weeks: weeks it rests on, six at most
-- least_per_day: flights a day in the emptiest of them
-- most_per_day: and in the fullest
-- Grain: operator, tail. Reads: flights.
create or replace view flight_rates as
with departures as (
    select
        operator,
        tail,
        flight_id,
        departed_at
    from flights
),

spans as (
    select
        operator,
        tail,
        min(departed_at) as first_at,
        max(departed_at) as last_at
    from departures
    group by operator, tail
),

weeks as (
    select
        *,
        unnest(range(6)) as week
    from spans
),

counted as (
    select
        w.operator,
        w.tail,
        w.week,
        count(f.flight_id) as n
    from weeks as w
    left join departures as f
        on
            w.operator = f.operator
            and w.tail = f.tail
            and w.last_at - to_days((7 * w.week + 7)::integer) < f.departed_at
            and w.last_at - to_days((7 * w.week)::integer) >= f.departed_at
    where w.last_at - to_days((7 * w.week + 7)::integer) >= w.first_at
    group by w.operator, w.tail, w.week
),

rates as (
    select
        operator,
        tail,
        median(n) / 7 as flights_per_day,
        count(*) as n_weeks,
        min(n) / 7 as least_per_day,
        max(n) / 7 as most_per_day
    from counted
    group by operator, tail
)

select
    s.operator,
    s.tail,
    s.last_at as last_departed_at,
    nullif(r.flights_per_day, 0) as flights_per_day,
    coalesce(r.n_weeks, 0) as n_weeks,
    r.least_per_day,
    r.most_per_day
from spans as s
left join rates as r on s.operator = r.operator and s.tail = r.tail;
