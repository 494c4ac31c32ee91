-- How long before its removal, wash or message did each unit's first alert come?
-- A unit's spell runs from one replacement or wash of its component to the next, as the flights show it; the last is
-- open. Its alert is the first of its own component raised in the spell that did not recover by itself; one after which
-- no fault was found only where there is no other. Spells without alert, message and work are left out.
-- spell: number of the spell of that component in that place, 0 for the one with which the record begins
-- begins_at: flights from then on belong to the spell; NULL for the first
-- work_action: REPLACED or CLEANED, what ended the spell; NULL while it is open
-- work_on: day the log gives for it
-- work_finding: what was found; NO_FAULT_FOUND where that alone
-- outcome: what came of the alert, as in alert_outcomes
-- work_at: flights from then on count as flown after the work
-- serial_off: serial number of the unit that came off, where the log gives it
-- diagnosis: of the alert, as in alerts
-- first_raised_at: when the spell's first alert was raised
-- first_message_at: when the component's first message of the spell was
-- flights_to_work: flights after the alert's until the work
-- days_to_work: time from the alert to the work [days]
-- flights_to_message: flights from the alert to the message, that of the message included
-- days_to_message: time from the alert to the message; negative where the message came first [days]
-- Grain: operator, tail, pack, component, spell (from 0). Reads: alert_outcomes, flights, maintenance,
-- tables.raw_messages, tables.components.
create or replace view removal_leads as
with work as (
    select
        operator,
        tail,
        position as pack,
        component,
        flown_from as counts_from,
        max(action) as work_action, -- REPLACED, where both were done
        min(done_on) as work_on,
        coalesce(max(nullif(finding, 'NO_FAULT_FOUND')), max(finding)) as work_finding,
        max(serial_off) as serial_off
    from maintenance
    where action in ('REPLACED', 'CLEANED') and position is not null and in_force
    group by operator, tail, position, component, flown_from
),

messages as (
    select
        m.operator,
        m.tail,
        m.pack,
        c.component,
        m.message_time
    from tables.raw_messages as m
    inner join tables.components as c on m.code = c.message_code
    where m.pack is not null
),

units as (
    select operator, tail, pack, component from work -- noqa: LT09
    union
    select operator, tail, pack, component from alert_outcomes -- noqa: LT09
    union
    select operator, tail, pack, component from messages -- noqa: LT09
),

ends as (
    select * from work
    union all by name
    select
        *,
        'infinity'::timestamptz as counts_from
    from units
),

spells as (
    select
        *,
        lag(counts_from) over own as begins_at,
        row_number() over own - 1 as spell
    from ends
    window own as (partition by operator, tail, pack, component order by counts_from)
),

alerted as (
    select
        s.operator,
        s.tail,
        s.pack,
        s.component,
        s.spell,
        a.raised_at as first_raised_at,
        a.alert_id,
        a.diagnosis,
        a.outcome
    from spells as s
    inner join alert_outcomes as a
        on
            s.operator = a.operator
            and s.tail = a.tail
            and s.pack = a.pack
            and s.component = a.component
            and coalesce(s.begins_at, '-infinity') <= a.raised_at
            and s.counts_from > a.raised_at
            and a.outcome != 'recovered'
    qualify
        row_number() over (
            partition by s.operator, s.tail, s.pack, s.component, s.spell
            order by a.outcome = 'no_fault_found', a.raised_at
        ) = 1
),

messaged as (
    select
        s.operator,
        s.tail,
        s.pack,
        s.component,
        s.spell,
        min(m.message_time) as first_message_at
    from spells as s
    inner join messages as m
        on
            s.operator = m.operator
            and s.tail = m.tail
            and s.pack = m.pack
            and s.component = m.component
            and coalesce(s.begins_at, '-infinity') <= m.message_time
            and s.counts_from > m.message_time
    group by s.operator, s.tail, s.pack, s.component, s.spell
),

joined as (
    select
        s.operator,
        s.tail,
        s.pack,
        s.component,
        s.spell,
        s.begins_at,
        a.alert_id,
        a.diagnosis,
        a.outcome,
        a.first_raised_at,
        m.first_message_at,
        s.work_action,
        s.work_on,
        s.work_finding,
        s.serial_off,
        case when s.work_action is not null then s.counts_from end as work_at
    from spells as s
    left join alerted as a
        on
            s.operator = a.operator
            and s.tail = a.tail
            and s.pack = a.pack
            and s.component = a.component
            and s.spell = a.spell
    left join messaged as m
        on
            s.operator = m.operator
            and s.tail = m.tail
            and s.pack = m.pack
            and s.component = m.component
            and s.spell = m.spell
    where s.work_action is not null or a.alert_id is not null or m.first_message_at is not null
),

flown as (
    select
        j.operator,
        j.tail,
        j.pack,
        j.component,
        j.spell,
        count(f.flight_id) filter (where j.work_at > f.departed_at) as flights_to_work,
        count(f.flight_id) filter (where j.first_message_at >= f.departed_at) as flights_to_message
    from joined as j
    inner join flights as f on j.operator = f.operator and j.tail = f.tail and j.first_raised_at < f.departed_at
    group by j.operator, j.tail, j.pack, j.component, j.spell
)

select
    j.*,
    case when j.work_at >= j.first_raised_at then coalesce(f.flights_to_work, 0) end as flights_to_work,
    (epoch(j.work_at) - epoch(j.first_raised_at)) / 86400 as days_to_work,
    case
        when j.first_message_at >= j.first_raised_at then coalesce(f.flights_to_message, 0)
    end as flights_to_message,
    (epoch(j.first_message_at) - epoch(j.first_raised_at)) / 86400 as days_to_message
from joined as j
left join flown as f
    on
        j.operator = f.operator
        and j.tail = f.tail
        and j.pack = f.pack
        and j.component = f.component
        and j.spell = f.spell;
