-- What came of each alert?
-- The one rule: every other view, page and figure reads it. Work counts for the alert that an engineer closed with it;
-- else for those of its pack and component that were open on its day, and, if it found something, for one that an
-- inspection closed as clean up to 14 days before; else for the one that closed last, up to 14 days before, unless a
-- new part closed it. A message counts while the alert was open and, unless a new part closed it, three days longer. A
-- recovery that no log explains is work where neither a sensor nor the door was in doubt.
-- diagnosis: of the alert, as in alerts
-- outcome: found (work found something), message (the aircraft raised its own), answered (a wash or replacement took
-- away a loss that the flights show), open, no_fault_found (an inspection or removal found nothing), recovered (by
-- itself), not_yet_known (work without a finding, and no flights show what it took away; or a fault of door or sensor
-- ended where no work is logged)
-- is_right: found, message or answered; NULL while it is open or not yet known
-- n_messages: messages of the component that count
-- message_at: time of the first
-- work_orders: references of the work that counts
-- finding: what the last of that work found
-- found_on: its day
-- Grain: alert. Reads: alert_cases, alerts, maintenance, unlogged_work, tables.raw_messages, tables.components.
create or replace view alert_outcomes as
with works as (
    select
        *,
        least(done_on, (flown_from at time zone 'UTC')::date) as work_on
    from maintenance
    where is_done
),

near as (
    select
        a.alert_id,
        w.done_on,
        w.action,
        w.finding,
        w.is_shown,
        w.reference,
        a.closed_at,
        case
            when w.closes_alert_id is not null
                then case when a.alert_id = coalesce(c.alert_id, w.closes_alert_id) then 1 end
            when coalesce(a.closed_on, w.work_on) >= w.work_on then 2
            when a.closed_reason = 'renewed' then null
            when a.closed_reason = 'found_clean' and coalesce(w.finding, '') not in ('', 'NO_FAULT_FOUND') then 2
            else 3
        end as claim,
        [w.operator, w.tail, w.position::varchar, w.component, w.action, w.flown_from::varchar, w.reference] as work
    from alerts as a
    inner join works as w
        on
            a.operator = w.operator
            and a.tail = w.tail
            and a.pack = w.position
            and a.component = w.component
            and a.raised_on <= w.work_on
            and (w.closes_alert_id is not null or coalesce(a.closed_on, w.work_on) + 14 >= w.work_on)
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

credits as (
    select
        alert_id,
        bool_or(coalesce(finding, '') not in ('', 'NO_FAULT_FOUND')) as has_found,
        bool_or(is_shown and finding is distinct from 'NO_FAULT_FOUND') as has_answered,
        bool_or(finding = 'NO_FAULT_FOUND') as has_found_nothing,
        bool_or(action in ('REPLACED', 'CLEANED', 'ADJUSTED')) as has_renewed,
        string_agg(distinct reference, ', ' order by reference) as work_orders,
        arg_max(finding, done_on) filter (where finding is not null) as finding,
        max(done_on) filter (where finding is not null) as found_on
    from credited
    group by alert_id
),

messages as (
    select
        a.alert_id,
        count(*) as n_messages,
        min(m.message_time) as message_at
    from alerts as a
    inner join tables.components as c on a.component = c.component
    inner join tables.raw_messages as m
        on
            a.operator = m.operator
            and a.tail = m.tail
            and a.pack = m.pack
            and a.raised_at <= m.message_time
            and c.message_code = m.code
            and (
                coalesce(a.closed_at >= m.message_time, true)
                or (a.closed_reason is distinct from 'renewed' and a.closed_at + interval 3 day >= m.message_time)
            )
    group by a.alert_id
),

recoveries as (
    select distinct a.alert_id
    from alerts as a
    inner join unlogged_work as u
        on
            a.operator = u.operator
            and a.tail = u.tail
            and a.pack = u.pack
            and a.component = u.component
            and a.raised_at < u.departed_at
            and coalesce(a.closed_at >= u.departed_at, true)
    anti join alerts as d
        on
            u.operator = d.operator
            and u.tail = d.tail
            and u.pack = d.pack
            and d.component in ('SENSOR', 'RAM_DOOR')
            and u.departed_at >= d.raised_at
            and coalesce(u.departed_at <= d.closed_at, true)
),

visible as (
    select a.alert_id
    from alerts as a
    left join tables.components as c on a.component = c.component
    where c.component is not null or a.operator in (select w.operator from works as w)
),

judged as (
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
            when w.has_found then 'found'
            when m.n_messages > 0 then 'message'
            when w.has_answered or r.alert_id is not null then 'answered'
            when a.closed_at is null then 'open'
            when w.has_found_nothing then 'no_fault_found'
            when w.has_renewed or v.alert_id is null or a.closed_reason != 'recovered' then 'not_yet_known'
            else 'recovered'
        end as outcome,
        coalesce(m.n_messages, 0) as n_messages,
        m.message_at,
        w.work_orders,
        w.finding,
        w.found_on
    from alerts as a
    left join visible as v on a.alert_id = v.alert_id
    left join credits as w on a.alert_id = w.alert_id
    left join messages as m on a.alert_id = m.alert_id
    left join recoveries as r on a.alert_id = r.alert_id
)

select
    *,
    case
        when outcome in ('found', 'message', 'answered') then true
        when outcome in ('no_fault_found', 'recovered') then false
    end as is_right
from judged;
