-- Wash, replace or defer at the next stop: with what chance of a message until the next check, and at what cost?
-- The chance of a washed or replaced unit is the median of the fleet's prognoses of such units, 5 to 25 flights after
-- the work. What a part is worth beyond the check is not included.
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
-- status: ok; no_check_planned (until_on is the horizon's end); beyond_horizon (of 300 flights); contradicted (the part
-- was found clean since); few_units (fewer than two such units on record); no_rate (flights a day unknown); no_cost
-- Grain: operator, tail, pack, component, choice. Reads: prognoses, check_chances, tables.raw_costs,
-- tables.raw_maintenance.
create or replace view next_stop as
with units as (
    select *
    from check_chances
    where is_observed -- money needs more than what the prior says of any unit
),

renewals as (
    select
        operator,
        tail,
        pack,
        component,
        counts_from,
        case when bool_or(action = 'REPLACED') then 'replace' else 'wash' end as choice
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
        case when item = 'at_check' then 'defer' else item end as choice,
        cost,
        currency
    from costs
    where item != 'message'
    union all by name
    select distinct
        u.component,
        'defer' as choice,
        null::double as cost,
        null::varchar as currency
    from units as u
    anti join costs as c on u.component = c.component and c.item = 'at_check'
),

chances as (
    select
        u.operator,
        u.tail,
        u.pack,
        u.component,
        u.check_name,
        u.until_on,
        u.days,
        u.flights,
        u.flights_per_day,
        o.choice,
        o.cost,
        m.cost as message_cost,
        o.currency,
        u.status as prognosis_status,
        case when o.choice != 'defer' then coalesce(r.n_units, 0) end as n_units,
        case when o.choice = 'defer' then u.points when r.n_units >= 2 then r.points end as points
    from units as u
    inner join choices as o on u.component = o.component
    left join renewed as r on o.component = r.component and o.choice = r.choice
    left join costs as m on u.component = m.component and m.item = 'message'
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
    chance_within(points, flights) as chance,
    case when flights > 300 then points[6] end as chance_at_least,
    cost,
    cost + chance_within(points, flights) * message_cost as expected_cost,
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
        when choice = 'defer' and prognosis_status != 'ok' then prognosis_status
        when cost is null or message_cost is null then 'no_cost'
        when check_name is null then 'no_check_planned'
        else 'ok'
    end as status
from chances;
