-- What work does each line of the maintenance log list, and did it count?
-- is_done: the work was done, by its status
-- in_force: the work counts
-- position: pack on which the flights show it
-- is_shown: the flights show that a loss recovered with it; NULL where no loss could
-- answered_by: reference and day by which messages name it; NULL where it answered none
-- flown_from: flights that depart from then on count as flown after it
-- matched_by: log (as it is listed), recovery (when and where the flights show that a loss recovered)
-- note: how it was taken otherwise than listed
-- Grain: operator, tail, file, done_on, pack, component, action, reference, finding.
-- Reads: tables.raw_maintenance, tables.raw_maintenance_not_done, tables.features_work, unit_lives, airframes.
create or replace view maintenance as
with lines as (
    select
        *,
        true as is_done
    from tables.raw_maintenance
    union all by name
    select
        *,
        false as is_done
    from tables.raw_maintenance_not_done
),

failures as (
    select
        operator,
        tail,
        pack,
        component,
        life,
        end_departed_at,
        lead(first_departed_at) over (partition by operator, tail, pack, component order by life) as next_departed_at
    from unit_lives
    qualify ended_by = 'message'
)

select
    m.*,
    f.msn,
    m.is_done and coalesce(w.in_force, true) as in_force,
    case when l.life is not null then concat_ws(' of ', m.reference, m.done_on) end as answered_by,
    coalesce(w.position, m.pack) as position,
    w.is_shown,
    coalesce(w.flown_from, m.counts_from) as flown_from,
    case
        when w.verdict in ('early', 'late', 'misdated', 'elsewhere') then 'recovery'
        when m.is_done then 'log'
    end as matched_by,
    case
        when not m.is_done then 'not done: ' || m.status
        when w.verdict = 'early' then 'dated before its message; the flights show it after'
        when w.verdict = 'late'
            then
                'logged ' || date_diff('day', (w.flown_from at time zone 'UTC')::date, m.done_on)
                || ' days after the flights show it'
        when w.verdict = 'misdated'
            then 'dated ' || m.done_on || '; the flights show it on ' || (w.flown_from at time zone 'UTC')::date
        when w.verdict = 'ahead' then 'dated long after the last flight of the aircraft; waits for its next one'
        when w.verdict = 'elsewhere' then 'the flights show it on pack ' || w.position
        when w.verdict = 'repeated' then 'the same work is listed before'
        when w.verdict = 'not_seen'
            then
                case when m.action = 'CLEANED' then 'wash' else 'replacement' end
                || ' of ' || m.done_on || ' not seen in the ten flights since'
    end as note
from lines as m
left join tables.features_work as w
    on
        m.is_done
        and m.operator = w.operator
        and m.tail = w.tail
        and m.pack = w.pack
        and m.component = w.component
        and m.action = w.action
        and m.counts_from = w.counts_from
        and m.reference is not distinct from w.reference
        and m.finding is not distinct from w.finding
left join failures as l
    on
        m.operator = l.operator
        and m.tail = l.tail
        and coalesce(w.position, m.pack) = l.pack
        and m.component = l.component
        and l.next_departed_at >= coalesce(w.flown_from, m.counts_from)
        and l.end_departed_at < coalesce(w.flown_from, m.counts_from)
        and m.is_done
        and coalesce(w.in_force, true)
        and m.action in ('REPLACED', 'CLEANED')
left join airframes as f on m.operator = f.operator and m.tail = f.tail;
