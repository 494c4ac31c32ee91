-- Which units of declared components are most in need of attention tonight?
-- urgency: act (a message before the next chance to act is more likely than not, or an alert demands it, by
-- unit_urgencies), plan (an alert is open, or that chance is one in ten), none, unknown (no estimate of the unit: its
-- columns are null)
-- name: what the night shift calls the component
-- loss: its loss after the last flight [-]
-- lost: what it loses
-- last_flight_id: its last flight
-- last_departed_at: departure of that
-- diagnoses: diagnoses of its open alerts
-- place: 1 is the most urgent; what is not known stands last
-- missing_since: departure of the first flight without an estimate, where nothing was seen
-- missing_reason: why most legs since were not admitted; a code, as in component_legs
-- work_action: CLEANED or REPLACED, where that was done since the last flight
-- work_on: day of that work
-- raised_at: when the oldest of the open alerts was raised
-- found_clean_on: day of an inspection without a finding since the last flight
-- message_at: time of the oldest message that nothing has answered
-- message_flights: flights on which it came
-- message_flown: flights since, the message's included
-- Grain: operator, tail, pack, component. Reads: component_features, missing_estimates, unit_urgencies,
-- unestimated_units, alert_urgencies, clean_units, open_messages, tables.components.
create or replace view component_ranking as
with latest as (
    select
        operator,
        tail,
        pack,
        component,
        arg_max(flight_id, departed_at) as last_flight_id,
        max(departed_at) as last_departed_at,
        arg_max(loss, departed_at) as loss,
        arg_max(loss_sd, departed_at) as loss_sd
    from component_features
    group by operator, tail, pack, component
),

outlook as (
    select *
    from unit_urgencies
    where
        (operator, tail, pack, component) not in (
            select (u.operator, u.tail, u.pack, u.component)
            from unestimated_units as u
        )
),

alerted as (
    select
        operator,
        tail,
        pack,
        component,
        string_agg(distinct diagnosis, ', ') as diagnoses,
        min(raised_at) as raised_at,
        bool_or(urgency = 'act') as any_act
    from alert_urgencies
    where closed_at is null
    group by operator, tail, pack, component
),

judged as (
    select
        l.operator,
        l.tail,
        l.pack,
        l.component,
        c.name,
        c.lost,
        o.chance,
        o.message_cost,
        case when u.component is null then l.loss end as loss,
        case when u.component is null then l.loss_sd end as loss_sd,
        o.rul_flights,
        o.rul_low,
        o.rul_high,
        o.p_event_50,
        a.diagnoses,
        l.last_flight_id,
        l.last_departed_at,
        case
            when coalesce(a.any_act, false) or o.urgency = 'act' then 'act'
            when a.diagnoses is not null or o.urgency = 'plan' then 'plan'
            when u.work_action is null and (l.loss is null or u.component is not null) then 'unknown'
            else 'none'
        end as urgency,
        m.since as missing_since,
        m.reason as missing_reason,
        u.work_action,
        u.work_on,
        a.raised_at,
        q.found_clean_on,
        t.message_at,
        t.n_flights as message_flights,
        t.n_flown as message_flown
    from latest as l
    left join open_messages as t
        on l.operator = t.operator and l.tail = t.tail and l.pack = t.pack and l.component = t.component
    left join clean_units as q
        on l.operator = q.operator and l.tail = q.tail and l.pack = q.pack and l.component = q.component
    left join unestimated_units as u
        on l.operator = u.operator and l.tail = u.tail and l.pack = u.pack and l.component = u.component
    left join missing_estimates as m
        on l.operator = m.operator and l.tail = m.tail and l.pack = m.pack and l.component = m.component
    left join tables.components as c on l.component = c.component
    left join outlook as o
        on l.operator = o.operator and l.tail = o.tail and l.pack = o.pack and l.component = o.component
    left join alerted as a
        on l.operator = a.operator and l.tail = a.tail and l.pack = a.pack and l.component = a.component
)

select
    * exclude (chance, message_cost),
    row_number() over (
        order by
            list_position(['act', 'plan', 'none', 'unknown'], urgency) asc,
            message_cost desc nulls last,
            chance desc nulls last,
            rul_flights asc nulls last,
            loss desc nulls last,
            operator asc,
            tail asc,
            pack asc,
            component asc
    ) as place
from judged;
