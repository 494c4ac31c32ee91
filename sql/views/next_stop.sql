-- Wash, replace or defer at the next stop: with what chance of a message until the next check, and at what cost?
-- The chance is the forecast of that very unit from the loss that the work leaves, at its own pace and demand; it never
-- rises with the thoroughness of the work. What a part is worth beyond the check is not included.
-- choice: wash, replace, or defer (to the check)
-- check_name: the check it is deferred to: the next that is planned after the aircraft's last flight
-- until_on: its day; where none is planned the end of horizon_days of the cost table
-- days: from the aircraft's last flight until then [days]
-- flights: the same in flights, at the aircraft's rate [flights]
-- flights_per_day: as in flight_rates
-- loss_left: what the choice leaves of the loss, the mean of what it may leave [-]
-- loss_left_sd: spread of what it may leave [-]
-- rests_on: what the effect of a wash rests on: prior, or the number of the fleet's washes after like losses and
-- findings
-- chance: of a message by then, with this choice [-]
-- chance_at_least: of 300 flights, where the check lies beyond them [-]
-- cost: of the work; of defer that at the check [currency]
-- expected_cost: cost and chance times the cost of a message; NULL where the part was found clean since [currency]
-- place: 1 is the least expected cost of the pack's component; NULL where there is none
-- status: ok; no_check_planned (until_on is the horizon's end); beyond_horizon (of 300 flights); contradicted (the part
-- was found clean since); no_rate (flights a day unknown); no_cost
-- Grain: operator, tail, pack, component, choice. Reads: check_chances, tables.prognosis_choices, tables.raw_costs.
create or replace view next_stop as
with units as (
    select *
    from check_chances
    where is_observed -- money needs more than what the prior says of any unit
),

costs as (
    select
        component,
        case when item = 'at_check' then 'defer' else item end as choice,
        max(cost) as cost,
        any_value(currency) as currency
    from tables.raw_costs
    group by all
),

choices as (
    select
        u.operator,
        u.tail,
        u.pack,
        u.component,
        c.choice,
        u.check_name,
        u.until_on,
        u.days,
        u.flights,
        u.flights_per_day,
        c.loss_left,
        c.loss_left_sd,
        c.rests_on,
        u.status as prognosis_status,
        [0.0, c.p_event_25, c.p_event_50, c.p_event_100, c.p_event_200, c.p_event_300] as points
    from units as u
    inner join tables.prognosis_choices as c
        on
            u.operator = c.operator
            and u.tail = c.tail
            and u.pack = c.pack
            and u.component = c.component
            and u.departed_at = c.departed_at
)

select
    c.operator,
    c.tail,
    c.pack,
    c.component,
    c.choice,
    c.check_name,
    c.until_on,
    c.days,
    c.flights,
    c.flights_per_day,
    c.loss_left,
    c.loss_left_sd,
    c.rests_on,
    chance_within(c.points, c.flights) as chance,
    case when c.flights > 300 then c.points[6] end as chance_at_least,
    w.cost,
    case when c.prognosis_status != 'contradicted' then w.cost + chance_within(c.points, c.flights) * m.cost end
        as expected_cost,
    w.currency,
    case
        when expected_cost is not null
            then row_number() over (
                partition by c.operator, c.tail, c.pack, c.component
                order by expected_cost asc nulls last, c.choice asc
            )
    end as place,
    case
        when c.flights is null then 'no_rate'
        when c.flights > 300 then 'beyond_horizon'
        when c.prognosis_status = 'contradicted' or (c.choice = 'defer' and c.prognosis_status != 'ok')
            then c.prognosis_status
        when w.cost is null or m.cost is null then 'no_cost'
        when c.check_name is null then 'no_check_planned'
        else 'ok'
    end as status
from choices as c
left join costs as w on c.component = w.component and c.choice = w.choice
left join costs as m on c.component = m.component and m.choice = 'message';
