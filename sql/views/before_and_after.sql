-- What did each piece of work change?
-- Neither side reaches beyond other work on the pack, or a recovery, that the log or the flights show.
-- pack: on which the flights show it
-- before_work: median of ten flights before, the six before the log's moment left out, in `unit`
-- after_work: median of the ten flights after, in `unit`
-- moved_by: after_work - before_work, in `unit`
-- Grain: operator, tail, pack, done_on, component, reference, parameter. Reads: health_parameters,
-- maintenance, unit_renewals.
create or replace view before_and_after as
with numbered as (
    select
        operator,
        tail,
        pack,
        parameter,
        unit,
        departed_at,
        value,
        row_number() over (partition by operator, tail, pack, parameter order by departed_at asc) as n
    from health_parameters
    where value is not null
),

works as (
    select
        w.operator,
        w.tail,
        w.position as pack,
        w.done_on,
        w.component,
        w.action,
        w.finding,
        w.reference,
        w.flown_from,
        max(r.flown_from) filter (where w.flown_from > r.flown_from) as begins_at,
        min(r.flown_from) filter (where w.flown_from < r.flown_from) as ends_at
    from maintenance as w
    left join unit_renewals as r
        on
            w.operator = r.operator
            and w.tail = r.tail
            and w.position = r.pack
            -- its own recovery, some days off the log, is no other work
            and not (
                w.action in ('REPLACED', 'CLEANED')
                and w.component = r.component
                and r.seen_by = 'flights'
                and abs(date_diff('day', w.flown_from, r.flown_from)) <= 7
            )
    where w.is_done
    group by all
),

placed as (
    select
        w.*,
        h.parameter,
        any_value(h.unit) as unit,
        coalesce(max(h.n) filter (where w.flown_from > h.departed_at), 0) as last_before
    from works as w
    inner join numbered as h on w.operator = h.operator and w.tail = h.tail and w.pack = h.pack
    group by all
),

medians as (
    select
        p.operator,
        p.tail,
        p.pack,
        p.done_on,
        p.component,
        p.action,
        p.finding,
        p.reference,
        p.parameter,
        p.unit,
        median(h.value) filter (where h.n between p.last_before - 15 and p.last_before - 6) as before_work,
        median(h.value) filter (where h.n between p.last_before + 1 and p.last_before + 10) as after_work
    from placed as p
    left join numbered as h
        on
            p.operator = h.operator
            and p.tail = h.tail
            and p.pack = h.pack
            and p.parameter = h.parameter
            and h.n between p.last_before - 15 and p.last_before + 10
            and coalesce(p.begins_at <= h.departed_at, true)
            and coalesce(p.ends_at > h.departed_at, true)
    group by all
)

select
    *,
    after_work - before_work as moved_by
from medians;
