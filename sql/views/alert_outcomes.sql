-- What came of each alert?
-- Work counts for the alert that an engineer closed with it; else for those of its pack and component that were open on
-- its day, and, if it found something, for one that an inspection closed as clean up to 14 days before; else for the
-- one that closed last, up to 14 days before, unless a new part closed it. A message counts while the alert was open.
-- outcome: open; confirmed (work on the component found something, or replaced it after a message); message (the
-- aircraft raised its own, no work is logged yet); replaced (without a finding); no_fault_found; nothing
-- n_messages: messages of the component while the alert was open
-- work_orders: references of the work that counts
-- finding: what the last of that work found
-- found_on: its day
-- Grain: alert. Reads: alert_cases, alerts, tables.raw_maintenance, tables.raw_messages, tables.components.
create or replace view alert_outcomes as
with near as (
    select
        a.alert_id,
        w.done_on,
        w.action,
        w.finding,
        w.reference,
        a.closed_at,
        case
            when w.closes_alert_id is not null
                then case when a.alert_id = coalesce(c.alert_id, w.closes_alert_id) then 1 end
            when coalesce(a.closed_on, w.done_on) >= w.done_on then 2
            when a.closed_reason = 'renewed' then null
            when a.closed_reason = 'found_clean' and coalesce(w.finding, '') not in ('', 'NO_FAULT_FOUND') then 2
            else 3
        end as claim,
        [w.operator, w.tail, w.pack::varchar, w.component, w.action, w.counts_from::varchar, w.reference] as work
    from alerts as a
    inner join tables.raw_maintenance as w
        on
            a.operator = w.operator
            and a.tail = w.tail
            and a.pack = w.pack
            and a.component = w.component
            and a.raised_on <= w.done_on
            and (w.closes_alert_id is not null or coalesce(a.closed_on, w.done_on) + 14 >= w.done_on)
    left join alert_cases as c on w.closes_alert_id = c.known_as
),

credited as (
    select *
    from near
    where claim is not null
    qualify
        claim = min(claim) over (partition by work)
        and (claim < 3 or closed_at = max(closed_at) over (partition by work))
),

work as (
    select
        alert_id,
        bool_or(coalesce(finding, '') not in ('', 'NO_FAULT_FOUND')) as found,
        bool_or(action = 'REPLACED') as replaced,
        bool_or(finding = 'NO_FAULT_FOUND') as no_fault_found,
        string_agg(distinct reference, ', ' order by reference) as work_orders,
        arg_max(finding, done_on) filter (where finding is not null) as finding,
        max(done_on) filter (where finding is not null) as found_on
    from credited
    group by alert_id
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
    w.work_orders,
    w.finding,
    w.found_on
from alerts as a
left join work as w on a.alert_id = w.alert_id
left join messages as m on a.alert_id = m.alert_id;
