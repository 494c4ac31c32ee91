-- How urgent is each unit by its last prognosis: how likely is its message before the next chance to act, at what cost?
-- The next chance to act is that of check_chances; without a flight rate or points, the next 50 flights.
-- chance: of a message by then; the least it can be where the prognosis does not look so far; NULL where the part was
-- found clean since: the forecast is of a loss that was not there [-]
-- chance_kind: by (until_on), at_least (of 300 flights, before until_on) or in_50 (flights)
-- message_cost: expected cost of that message; NULL without a cost table [currency]
-- urgency: act (a message on record that nothing has answered, by open_messages; or one more likely than not, by
-- act_states), plan (one in ten), none
-- urgent_since: since when it is act: time of that message, or departure of the flight with which the chance passed 0.5
-- urgent_by: message; flights (its own flights changed the forecast); fleet (a new model, from the fleet's record, did)
-- Grain: operator, tail, pack, component. Reads: check_chances, act_states, open_messages, tables.raw_costs.
create or replace view unit_urgencies as
with message_costs as (
    select
        component,
        max(cost) as cost
    from tables.raw_costs
    where item = 'message'
    group by component
),

forecasts as (
    select
        *,
        case when is_observed then coalesce(chance, chance_at_least, p_event_50) end as forecast_chance
    from check_chances
),

chances as (
    select
        c.operator,
        c.tail,
        c.pack,
        c.component,
        c.rul_flights,
        c.rul_low,
        c.rul_high,
        c.p_event_50,
        c.status,
        c.is_observed,
        c.check_name,
        c.until_on,
        c.flights_per_day,
        case
            when c.chance is not null then 'by'
            when c.chance_at_least is not null then 'at_least'
            else 'in_50'
        end as chance_kind,
        c.forecast_chance,
        case when c.status != 'contradicted' then c.forecast_chance end as chance,
        case when c.is_observed and c.status != 'contradicted' then c.chance end * m.cost as message_cost
    from forecasts as c
    left join message_costs as m on c.component = m.component
),

judged as (
    select
        c.*,
        case
            when m.is_pressing or a.since is not null then 'act'
            when c.forecast_chance >= 0.1 then 'plan'
            else 'none'
        end as urgency,
        case when m.is_pressing then m.message_at else a.since end as urgent_since,
        case when m.is_pressing then 'message' else a.changed_by end as urgent_by
    from chances as c
    left join act_states as a
        on c.operator = a.operator and c.tail = a.tail and c.pack = a.pack and c.component = a.component
    left join open_messages as m
        on c.operator = m.operator and c.tail = m.tail and c.pack = m.pack and c.component = m.component
)

select * exclude (forecast_chance)
from judged;
