-- Wash, replace or defer at the next stop: with what chance of a message until the next check, and at what cost?
-- Chances are the prognosis's own points (25 to 300 flights), between them by a hazard that is even from point to
-- point. That of a washed or replaced unit is what the fleet's prognoses said of such units, 5 to 25 flights after the
-- work, in the median. Costs are those of costs.toml; an expected cost is that of the work and, times the chance, of a
-- message. What a part is worth beyond the check is not in it.
-- choice: wash, replace, or defer (to the check)
-- check_name: the check it is deferred to: the next that is planned after the aircraft's last flight
-- until_on: its day; where none is planned the end of horizon_days of the cost table
-- days: from the aircraft's last flight until then [days]
-- flights: the same in flights, at the aircraft's rate [flights]
-- flights_per_day: as in flight_rates
-- chance: of a message by then, with this choice [-]
-- chance_at_least: of 300 flights, where the check lies beyond them [-]
-- cost: of the work [currency]
-- expected_cost: cost and chance times the cost of a message [currency]
-- n_units: units of the fleet that the chance after a wash or a replacement rests on
-- place: 1 is the least expected cost of the pack's component; NULL where there is none
-- status: ok; no_check_planned (until_on is the horizon's end); beyond_horizon (the prognosis looks 300 flights ahead
-- and no further: no chance is told); contradicted (the part was found clean since); few_units (fewer than two such
-- units were seen); no_rate (how often the aircraft flies is not known); no_cost (the cost table has none, or is wrong)
-- Grain: operator, tail, pack, component, choice. Reads: prognoses, flight_rates, tables.raw_checks,
-- tables.raw_costs, tables.raw_maintenance.
create or replace view next_stop as
with latest as (
    select
        operator,
        tail,
        pack,
        component,
        arg_max(status, departed_at) as said_status,
        arg_max([0.0, p_event_25, p_event_50, p_event_100, p_event_200, p_event_300], departed_at) as points
    from prognoses
    where p_event_50 is not null
    group by operator, tail, pack, component
),

renewals as (
    select
        operator,
        tail,
        pack,
        component,
        counts_from,
        if(bool_or(action = 'REPLACED'), 'replace', 'wash') as choice
    from tables.raw_maintenance
    where action in ('REPLACED', 'CLEANED') and pack is not null
    group by operator, tail, pack, component, counts_from
),

young as (
    select
        p.component,
        r.choice,
        [p.operator, p.tail, p.pack::varchar, r.counts_from::varchar] as unit,
        [0.0, p.p_event_25, p.p_event_50, p.p_event_100, p.p_event_200, p.p_event_300] as points
    from prognoses as p
    asof inner join renewals as r
        on
            p.operator = r.operator
            and p.tail = r.tail
            and p.pack = r.pack
            and p.component = r.component
            and p.departed_at >= r.counts_from
    where p.p_event_50 is not null
    qualify
        row_number() over (
            partition by p.operator, p.tail, p.pack, p.component, r.counts_from
            order by p.departed_at asc
        ) between 5 and 25
),

renewed as (
    select
        component,
        choice,
        count(distinct unit) as n_units,
        [
            0.0,
            median(points[2]),
            median(points[3]),
            median(points[4]),
            median(points[5]),
            median(points[6])
        ] as points
    from young
    group by component, choice
),

horizons as (
    select coalesce(max(horizon_days), 30)::integer as horizon_days from tables.raw_costs
),

checks as (
    select
        f.operator,
        f.tail,
        min(c.planned_on) as planned_on,
        arg_min(c.name, c.planned_on) as name
    from flight_rates as f
    inner join tables.raw_checks as c
        on f.operator = c.operator and f.tail = c.tail and (f.last_departed_at at time zone 'UTC')::date < c.planned_on
    group by f.operator, f.tail
),

spans as (
    select
        f.operator,
        f.tail,
        f.flights_per_day,
        c.name as check_name,
        c.planned_on is not null as planned,
        coalesce(c.planned_on, (f.last_departed_at at time zone 'UTC')::date + h.horizon_days) as until_on,
        until_on - (f.last_departed_at at time zone 'UTC')::date as days,
        days * f.flights_per_day as flights
    from flight_rates as f
    cross join horizons as h
    left join checks as c on f.operator = c.operator and f.tail = c.tail
),

costs as (
    select
        component,
        item,
        max(cost) as cost,
        any_value(currency) as currency
    from tables.raw_costs
    group by component, item
),

choices as (
    select
        component,
        if(item = 'at_check', 'defer', item) as choice,
        cost,
        currency
    from costs
    where item != 'message'
    union all by name
    select distinct
        l.component,
        'defer' as choice,
        null::double as cost,
        null::varchar as currency
    from latest as l
    anti join costs as c on l.component = c.component and c.item = 'at_check'
),

placed as (
    select
        l.operator,
        l.tail,
        l.pack,
        l.component,
        o.choice,
        s.check_name,
        s.planned,
        s.until_on,
        s.days,
        s.flights,
        s.flights_per_day,
        o.cost,
        m.cost as message_cost,
        o.currency,
        l.said_status,
        if(o.choice = 'defer', null, coalesce(r.n_units, 0)) as n_units,
        if(o.choice = 'defer' or r.n_units >= 2, if(o.choice = 'defer', l.points, r.points), null) as points,
        [0, 25, 50, 100, 200, 300] as knots
    from latest as l
    inner join choices as o on l.component = o.component
    left join spans as s on l.operator = s.operator and l.tail = s.tail
    left join renewed as r on o.component = r.component and o.choice = r.choice
    left join costs as m on l.component = m.component and m.item = 'message'
    where l.said_status != 'prior_only' -- money needs more than what is believed of any unit
),

segments as (
    select
        *,
        case
            when flights < 25 then 1
            when flights < 50 then 2
            when flights < 100 then 3
            when flights < 200 then 4
            when flights <= 300 then 5
        end as k
    from placed
),

told as (
    select
        *,
        if(points[k] is null, null, ln(greatest(1 - points[k], 1e-9))) as before,
        if(points[k + 1] is null, null, ln(greatest(1 - points[k + 1], 1e-9))) as after,
        (flights - knots[k]) / (knots[k + 1] - knots[k]) as share
    from segments
),

chances as (
    select
        *,
        1 - exp(before + share * (after - before)) as chance
    from told
)

select
    operator,
    tail,
    pack,
    component,
    choice,
    check_name,
    until_on,
    days,
    flights,
    flights_per_day,
    chance,
    if(flights > 300, points[6], null) as chance_at_least,
    cost,
    cost + chance * message_cost as expected_cost,
    currency,
    n_units,
    case
        when expected_cost is not null
            then row_number() over (
                partition by operator, tail, pack, component order by expected_cost asc nulls last, choice asc
            )
    end as place,
    case
        when flights is null then 'no_rate'
        when points is null then 'few_units'
        when flights > 300 then 'beyond_horizon'
        when choice = 'defer' and said_status != 'ok' then said_status
        when cost is null or message_cost is null then 'no_cost'
        when not planned then 'no_check_planned'
        else 'ok'
    end as status
from chances;
