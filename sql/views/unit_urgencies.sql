-- How urgent is each unit by its last prognosis: how likely is its message before the next chance to act, at what cost?
-- The next chance to act is the next planned check, else the end of the cost table's horizon (30 days); where it is not
-- known how often the aircraft flies, or the points lack, the next 50 flights.
-- chance: of a message by then; the least it can be where the prognosis does not look so far [-]
-- message_cost: expected cost of that message; NULL without a cost table [currency]
-- urgency: act (more likely than not, and no inspection contradicts it), plan (one in ten), none
-- Grain: operator, tail, pack, component. Reads: prognoses, next_stop.
create or replace view unit_urgencies as
with latest as (
    select
        operator,
        tail,
        pack,
        component,
        arg_max(rul_flights, departed_at) as rul_flights,
        arg_max(rul_low, departed_at) as rul_low,
        arg_max(rul_high, departed_at) as rul_high,
        arg_max(p_event_50, departed_at) as p_event_50,
        arg_max(status, departed_at) as status
    from prognoses
    group by operator, tail, pack, component
),

chances as (
    select
        l.*,
        if(l.status = 'prior_only', null, coalesce(s.chance, s.chance_at_least, l.p_event_50)) as chance,
        s.expected_cost - s.cost as message_cost
    from latest as l
    left join next_stop as s
        on
            l.operator = s.operator
            and l.tail = s.tail
            and l.pack = s.pack
            and l.component = s.component
            and s.choice = 'defer'
)

select
    *,
    case
        when chance >= 0.5 and status = 'ok' then 'act'
        when chance >= 0.1 then 'plan'
        else 'none'
    end as urgency
from chances;
