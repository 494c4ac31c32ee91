-- How long before the aircraft's own message was the alert raised?
-- A case is the first message of a component of a pack since its last replacement; its alert is the first for which
-- alert_outcomes counts that message. Lead is null where no alert came first.
-- diagnosis: of the alert, as in alerts
-- n_messages: messages of the case
-- lead_flights: flights from the alert to the message, that of the message included
-- lead_days: time from the alert to the message [days]
-- Grain: operator, tail, pack, component, message_time. Reads: alert_outcomes, flights, maintenance,
-- tables.raw_messages, tables.components.
create or replace view alert_lead_times as
with messages as (
    select
        m.operator,
        m.tail,
        m.pack,
        m.message_time,
        m.code,
        c.component
    from tables.raw_messages as m
    inner join tables.components as c on m.code = c.message_code
    where m.pack is not null
),

placed as (
    select
        m.operator,
        m.tail,
        m.pack,
        m.component,
        m.code,
        m.message_time,
        max(w.flown_from) as replaced_at
    from messages as m
    left join maintenance as w
        on
            m.operator = w.operator
            and m.tail = w.tail
            and m.pack = w.position
            and m.component = w.component
            and w.in_force
            and w.action = 'REPLACED'
            and m.message_time >= w.flown_from
    group by m.operator, m.tail, m.pack, m.component, m.code, m.message_time
),

cases as (
    select
        operator,
        tail,
        pack,
        component,
        replaced_at,
        min(message_time) as message_time,
        arg_min(code, message_time) as code,
        count(*) as n_messages
    from placed
    group by operator, tail, pack, component, replaced_at
),

warned as (
    select
        c.operator,
        c.tail,
        c.pack,
        c.component,
        c.code,
        c.message_time,
        c.n_messages,
        min(a.raised_at) as raised_at,
        arg_min(a.alert_id, a.raised_at) as alert_id,
        arg_min(a.diagnosis, a.raised_at) as diagnosis
    from cases as c
    left join alert_outcomes as a
        on
            c.operator = a.operator
            and c.tail = a.tail
            and c.pack = a.pack
            and c.component = a.component
            and c.message_time = a.message_at
    group by c.operator, c.tail, c.pack, c.component, c.code, c.message_time, c.n_messages
),

flown as (
    select
        w.alert_id,
        w.message_time,
        count(*) as lead_flights
    from warned as w
    inner join flights as f
        on
            w.operator = f.operator
            and w.tail = f.tail
            and w.raised_at < f.departed_at
            and w.message_time >= f.departed_at
    group by w.alert_id, w.message_time
)

select
    w.operator,
    w.tail,
    w.pack,
    w.component,
    w.code,
    w.message_time,
    w.n_messages,
    w.alert_id,
    w.diagnosis,
    w.raised_at,
    f.lead_flights,
    (epoch(w.message_time) - epoch(w.raised_at)) / 86400 as lead_days
from warned as w
left join flown as f on w.alert_id = f.alert_id and w.message_time = f.message_time;
