-- How do weather, health and faults move through the year?
-- calendar_month: 1 to 12 (UTC)
-- n_flights: flights of the operator in that month, all years
-- n_tails: aircraft that flew them
-- tat_cruise_k: median total air temperature in cruise [K]
-- tat_ground_k: median total air temperature on the ground [K]
-- ram_door_open_cruise: median ram door position in cruise, share open [-]
-- hx_fouling: median fouling of all packs and flights [-]
-- cc_efficiency_loss: median loss of compressor efficiency [-]
-- p_event_50: mean chance of an exchanger's message within 50 flights, of all packs and flights [-]
-- margin_k: median cooling margin of all packs and flights [K]
-- margin_worst_tenth_k: margin that a tenth of them stay below [K]
-- alerts_per_1000_flights: alerts raised per thousand flights
-- messages_per_1000_flights: messages of the aircraft per thousand flights
-- Grain: operator, calendar_month (1 to 12). Reads: flights, health_parameters, prognoses, features, alerts,
-- tables.legs_samples, tables.raw_messages.
create or replace view seasonality as
with flown as (
    select
        operator,
        month(departed_at at time zone 'UTC') as calendar_month,
        count(*) as n_flights,
        count(distinct tail) as n_tails
    from flights
    group by operator, calendar_month
),

weather as (
    select
        operator,
        month(time_utc at time zone 'UTC') as calendar_month,
        median(tat_k) filter (where phase = 'cruise') as tat_cruise_k,
        median(tat_k) filter (where phase = 'ground') as tat_ground_k,
        median(ram_door_open) filter (where phase = 'cruise') as ram_door_open_cruise
    from tables.legs_samples
    group by operator, calendar_month
),

health as (
    select
        operator,
        month(departed_at at time zone 'UTC') as calendar_month,
        median(value) filter (where parameter = 'hx_fouling') as hx_fouling,
        median(value) filter (where parameter = 'cc_efficiency_loss') as cc_efficiency_loss
    from health_parameters
    group by operator, calendar_month
),

outlook as (
    select
        operator,
        month(departed_at at time zone 'UTC') as calendar_month,
        avg(p_event_50) as p_event_50
    from prognoses
    where component = 'HX'
    group by operator, calendar_month
),

margins as (
    select
        operator,
        month(departed_at at time zone 'UTC') as calendar_month,
        median(hx_margin_k) as margin_k,
        quantile_cont(hx_margin_k, 0.1) as margin_worst_tenth_k
    from features
    group by operator, calendar_month
),

raised as (
    select
        operator,
        month(raised_at at time zone 'UTC') as calendar_month,
        count(*) as n_alerts
    from alerts
    group by operator, calendar_month
),

messages as (
    select
        operator,
        month(message_time at time zone 'UTC') as calendar_month,
        count(*) as n_messages
    from tables.raw_messages
    group by operator, calendar_month
)

select
    f.operator,
    f.calendar_month,
    f.n_flights,
    f.n_tails,
    w.tat_cruise_k,
    w.tat_ground_k,
    w.ram_door_open_cruise,
    h.hx_fouling,
    h.cc_efficiency_loss,
    o.p_event_50,
    k.margin_k,
    k.margin_worst_tenth_k,
    1000 * coalesce(a.n_alerts, 0) / f.n_flights as alerts_per_1000_flights,
    1000 * coalesce(m.n_messages, 0) / f.n_flights as messages_per_1000_flights
from flown as f
left join weather as w on f.operator = w.operator and f.calendar_month = w.calendar_month
left join health as h on f.operator = h.operator and f.calendar_month = h.calendar_month
left join outlook as o on f.operator = o.operator and f.calendar_month = o.calendar_month
left join margins as k on f.operator = k.operator and f.calendar_month = k.calendar_month
left join raised as a on f.operator = a.operator and f.calendar_month = a.calendar_month
left join messages as m on f.operator = m.operator and f.calendar_month = m.calendar_month;
