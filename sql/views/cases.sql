-- How does each alert's case stand: who has it in hand, until when is it muted, what was found?
-- alert_id: its alert
-- state: closed; confirmed (a fault, not mended yet); muted; worsened (muted, but a class of severity, 0.05 of loss or
-- 0.2 of the chance of an event within 50 flights worse); acknowledged; new
-- owner: to whom it was assigned last
-- acknowledged_by: who acknowledged it first
-- muted_until: until when it is muted, where it was not taken back
-- muted_by: who muted it
-- mute_note: why
-- watched_by: who watches it
-- finding: what the engineer who closed it found
-- found_by: who that was
-- found_on: day of the work
-- work: what was done: REPLACED, CLEANED, INSPECTED or ADJUSTED
-- last_line: number of the last line that a person wrote about it, 0 for none
-- last_at: when that was
-- last_by: who wrote it
-- last_kind: what it said
-- last_note: why
-- case_id: id of the case; alert_id is its alert's, which may be another after the next night
-- Grain: alert. Reads: alert_cases, alert_states, tables.raw_cases.
create or replace view cases as
with by_people as (
    select * exclude (alert_id)
    from tables.raw_cases
    where kind not in ('follow', 'withdraw')
),

entries as (
    select
        p.*,
        c.alert_id,
        max(p.line) filter (where p.kind = 'reopen') over (partition by c.alert_id) as reopened
    from by_people as p
    inner join alert_cases as c on p.case_id = c.known_as
),

watched as (
    select
        alert_id,
        person,
        arg_max(kind, line) as kind
    from entries
    where kind in ('watch', 'unwatch')
    group by alert_id, person
),

watchers as (
    select
        alert_id,
        string_agg(person, ', ' order by person) as watched_by
    from watched
    where kind = 'watch'
    group by alert_id
),

last_entries as (
    select
        alert_id,
        arg_max(assignee, line) filter (where kind = 'assign') as owner,
        arg_min(person, line) filter (where kind = 'acknowledge') as acknowledged_by,
        max(line) filter (where kind = 'mute' and line > coalesce(reopened, 0)) as muted,
        max(line) filter (where kind = 'close' and line > coalesce(reopened, 0)) as found,
        max(line) as last_line
    from entries
    group by alert_id
),

standing as (
    select
        a.alert_id,
        a.case_id,
        a.operator,
        a.tail,
        a.pack,
        a.component,
        a.diagnosis,
        a.severity,
        a.urgency,
        a.raised_at,
        a.closed_at,
        a.closed_reason,
        f.owner,
        f.acknowledged_by,
        m.until as muted_until,
        m.person as muted_by,
        m.note as mute_note,
        w.watched_by,
        c.finding,
        c.person as found_by,
        c.done_on as found_on,
        c.action as work,
        coalesce(f.last_line, 0) as last_line,
        l.at as last_at,
        l.person as last_by,
        l.kind as last_kind,
        l.note as last_note,
        coalesce(
            list_position(['low', 'medium', 'high'], a.severity)
            > list_position(['low', 'medium', 'high'], m.severity_then)
            or a.now_loss >= m.loss_then + 0.05
            or a.now_p_event_50 >= m.p_event_50_then + 0.2,
            false
        ) as worse
    from alert_states as a
    left join last_entries as f on a.alert_id = f.alert_id
    left join watchers as w on a.alert_id = w.alert_id
    left join entries as m on f.muted = m.line and f.alert_id = m.alert_id
    left join entries as c on f.found = c.line and f.alert_id = c.alert_id
    left join entries as l on f.last_line = l.line and f.alert_id = l.alert_id
)

select
    * exclude (worse),
    case
        when closed_at is not null then 'closed'
        when finding is not null then 'confirmed'
        when muted_until > now() and worse then 'worsened'
        when muted_until > now() then 'muted'
        when acknowledged_by is not null or owner is not null then 'acknowledged'
        else 'new'
    end as state
from standing;
