-- How urgent is each unit by its last prognosis: how likely is its message before the next chance to act, at what cost?
-- The next chance to act is that of check_chances; without a flight rate or points, the next 50 flights.
-- chance: of a message by then; the least it can be where the prognosis does not look so far [-]
-- message_cost: expected cost of that message; NULL without a cost table [currency]
-- urgency: act (a message on record that nothing has answered, by open_messages; or more likely than not, and no
-- inspection contradicts it), plan (one in ten), none
-- Grain: operator, tail, pack, component. Reads: check_chances, open_messages, tables.raw_costs.
create or replace view unit_urgencies as
with message_costs as (
    select
        component,
        max(cost) as cost
    from tables.raw_costs
    where item = 'message'
    group by component
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
        case when c.is_observed then coalesce(c.chance, c.chance_at_least, c.p_event_50) end as chance,
        case when c.is_observed then c.chance end * m.cost as message_cost
    from check_chances as c
    left join message_costs as m on c.component = m.component
)

select
    c.*,
    case
        when m.is_pressing or (c.chance >= 0.5 and c.status = 'ok') then 'act'
        when c.chance >= 0.1 then 'plan'
        else 'none'
    end as urgency
from chances as c
left join open_messages as m
    on c.operator = m.operator and c.tail = m.tail and c.pack = m.pack and c.component = m.component;
