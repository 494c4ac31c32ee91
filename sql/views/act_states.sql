-- Of which units is a message more likely than not before the next chance to act, since when, and what brought it?
-- Such a state begins with the flight after which the chance passes 0.5 and ends with the one after which it is below
-- 0.4, so that a forecast about 0.5 does not come and go; work, an inspection without a finding and a flight without a
-- sound forecast end it, too. Flights of the last 90 days count, each with the check that was the next then and the
-- aircraft's present rate of flights.
-- since: departure of the flight with which it began
-- changed_by: fleet (with that flight's forecast came a new model, of the fleet's record) or flights (its own)
-- Grain: operator, tail, pack, component. Reads: prognoses, check_chances, tables.raw_checks, tables.raw_costs,
-- settled_work.
create or replace view act_states as
with ends as (
    select
        operator,
        tail,
        pack,
        component,
        case when bool_or(since_night) then 'infinity'::timestamptz else max(counts_from) end as ended_at
    from settled_work
    where action in ('REPLACED', 'CLEANED') or (action = 'INSPECTED' and finding = 'NO_FAULT_FOUND')
    group by operator, tail, pack, component
),

horizons as (
    select coalesce(max(horizon_days), 30)::integer as horizon_days from tables.raw_costs
),

forecasts as (
    select
        p.operator,
        p.tail,
        p.pack,
        p.component,
        p.flight_id,
        p.departed_at,
        p.model_version,
        p.status,
        p.p_event_50,
        u.flights_per_day,
        (p.departed_at at time zone 'UTC')::date as departed_on,
        [0.0, p.p_event_25, p.p_event_50, p.p_event_100, p.p_event_200, p.p_event_300] as points
    from prognoses as p
    inner join check_chances as u
        on p.operator = u.operator and p.tail = u.tail and p.pack = u.pack and p.component = u.component
    left join ends as e
        on p.operator = e.operator and p.tail = e.tail and p.pack = e.pack and p.component = e.component
    where
        p.p_event_50 is not null
        and p.departed_at > u.departed_at - interval 90 days
        and (e.ended_at is null or p.departed_at >= e.ended_at)
),

planned as (
    select
        operator,
        tail,
        planned_on
    from tables.raw_checks
),

spans as (
    select
        f.*,
        (coalesce(c.planned_on, f.departed_on + h.horizon_days) - f.departed_on) * f.flights_per_day as flights
    from forecasts as f
    cross join horizons as h
    asof left join planned as c on f.operator = c.operator and f.tail = c.tail and f.departed_on < c.planned_on
),

chances as (
    select
        *,
        case
            when status != 'ok' then 0
            when flights > 300 then points[6]
            else coalesce(chance_within(points, flights), p_event_50)
        end as chance,
        coalesce(model_version != lag(model_version) over own, false) as has_new_model
    from spans
    window own as (partition by operator, tail, pack, component order by departed_at, flight_id)
),

since_low as (
    select
        *,
        count(*) filter (where chance < 0.4) over (
            partition by operator, tail, pack, component order by departed_at desc, flight_id desc
        ) as n_low_from_here
    from chances
)

select
    operator,
    tail,
    pack,
    component,
    min(departed_at) as since,
    case when arg_min(has_new_model, departed_at) then 'fleet' else 'flights' end as changed_by
from since_low
where n_low_from_here = 0 and chance >= 0.5
group by operator, tail, pack, component;
