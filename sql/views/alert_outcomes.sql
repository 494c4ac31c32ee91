-- What came of each alert?
-- Work counts from the day of the alert until 14 days after it closed, a message until it closed.
-- outcome: open; confirmed (work on the component found something, or replaced it after a message); message (the
-- aircraft raised its own, no work is logged yet); replaced (without a finding); no_fault_found; nothing
-- n_messages: messages of the component while the alert was open
-- work_orders: references of the work that counts
-- Grain: alert. Reads: alerts, tables.raw_maintenance, tables.raw_messages, tables.components.
create or replace view alert_outcomes as
with work as (
    select
        a.alert_id,
        bool_or(coalesce(w.finding, '') not in ('', 'NO_FAULT_FOUND')) as found,
        bool_or(w.action = 'REPLACED') as replaced,
        bool_or(w.finding = 'NO_FAULT_FOUND') as no_fault_found,
        string_agg(distinct w.reference, ', ' order by w.reference) as work_orders
    from alerts as a
    inner join tables.raw_maintenance as w
        on
            a.operator = w.operator
            and a.tail = w.tail
            and a.pack = w.pack
            and a.component = w.component
            and w.done_on >= (a.raised_at at time zone 'UTC')::date
            and w.done_on <= (coalesce(a.closed_at, now()) at time zone 'UTC')::date + 14
    group by a.alert_id
),

messages as (
    select
        a.alert_id,
        count(*) as n_messages
    from alerts as a
    inner join tables.components as c on a.component = c.component
    inner join tables.raw_messages as m
        on
            a.operator = m.operator
            and a.tail = m.tail
            and a.pack = m.pack
            and a.raised_at <= m.message_time
            and coalesce(a.closed_at, now()) >= m.message_time
            and c.message_code = m.code
    group by a.alert_id
)

select
    a.alert_id,
    a.operator,
    a.tail,
    a.pack,
    a.component,
    a.diagnosis,
    a.severity,
    a.raised_at,
    a.closed_at,
    case
        when w.found or (w.replaced and m.n_messages > 0) then 'confirmed'
        when a.closed_at is null then 'open'
        when w.replaced then 'replaced'
        when m.n_messages > 0 then 'message'
        when w.no_fault_found then 'no_fault_found'
        else 'nothing'
    end as outcome,
    coalesce(m.n_messages, 0) as n_messages,
    w.work_orders
from alerts as a
left join work as w on a.alert_id = w.alert_id
left join messages as m on a.alert_id = m.alert_id;
