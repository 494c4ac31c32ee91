-- What did the system say on that date?
-- Ask it `select * from as_of where on_date = '2024-05-20'`; each row rests on flights up to that day alone.
-- on_date: the day at whose end (UTC) this was known
-- hx_fouling: fouling after the pack's last flight by then [-]
-- hx_fouling_sd: its standard deviation [-]
-- open_diagnoses: diagnoses of the alerts open by then
-- Grain: on_date, operator, tail, pack. Reads: health_parameters, prognoses, alerts.
create or replace view as_of as
with bounds as (
    select
        operator,
        tail,
        pack,
        min((departed_at at time zone 'UTC')::date) as first_on
    from health_parameters
    group by operator, tail, pack
),

last_day as (
    select max((departed_at at time zone 'UTC')::date) as last_on from health_parameters
),

calendar as (
    select
        b.operator,
        b.tail,
        b.pack,
        unnest(generate_series(b.first_on, d.last_on, interval 1 day))::date as on_date
    from bounds as b
    cross join last_day as d
),

days as (
    select
        operator,
        tail,
        pack,
        on_date,
        (on_date + 1)::timestamp at time zone 'UTC' as ends_at
    from calendar
),

fouling as (
    select *
    from health_parameters
    where parameter = 'hx_fouling'
),

outlook as (
    select *
    from prognoses
    where component = 'HX'
),

states as (
    select
        d.on_date,
        d.operator,
        d.tail,
        d.pack,
        h.flight_id,
        h.departed_at,
        h.value as hx_fouling,
        h.sd as hx_fouling_sd,
        p.rul_flights,
        p.rul_low,
        p.rul_high,
        p.p_event_50,
        p.split,
        d.ends_at
    from days as d
    asof left join fouling as h
        on d.operator = h.operator and d.tail = h.tail and d.pack = h.pack and d.ends_at > h.departed_at
    asof left join outlook as p
        on d.operator = p.operator and d.tail = p.tail and d.pack = p.pack and d.ends_at > p.departed_at
)

select
    k.on_date,
    k.operator,
    k.tail,
    k.pack,
    k.flight_id,
    k.departed_at,
    k.hx_fouling,
    k.hx_fouling_sd,
    k.rul_flights,
    k.rul_low,
    k.rul_high,
    k.p_event_50,
    k.split,
    string_agg(distinct a.diagnosis, ', ' order by a.diagnosis) as open_diagnoses
from states as k
left join alerts as a
    on
        k.operator = a.operator
        and k.tail = a.tail
        and k.pack = a.pack
        and k.ends_at > a.raised_at
        and (a.closed_at is null or k.ends_at <= a.closed_at)
group by all;
