-- Which messages did the aircraft raise, and which work answered each?
-- answered_by: reference and day of the work; NULL where none answered it
-- matched_by: log (work that was logged in time), recovery (work that the flights show otherwise than it is logged)
-- note: how the work is logged otherwise
-- Grain: operator, tail, file, message_time, pack, code.
-- Reads: tables.raw_messages, tables.components, flights, unit_lives, maintenance,
-- airframes.
create or replace view messages as
with failures as (
    select
        *,
        lead(first_departed_at) over (partition by operator, tail, pack, component order by life) as next_departed_at
    from unit_lives
),

works as (
    select
        l.operator,
        l.tail,
        l.pack,
        l.component,
        l.end_departed_at,
        l.next_departed_at,
        w.answered_by,
        w.matched_by,
        w.note
    from failures as l
    inner join maintenance as w
        on
            l.operator = w.operator
            and l.tail = w.tail
            and l.pack = w.position
            and l.component = w.component
            and l.next_departed_at >= w.flown_from
            and l.end_departed_at < w.flown_from
            and w.answered_by is not null
    where l.ended_by = 'message'
    qualify
        row_number() over (
            partition by l.operator, l.tail, l.pack, l.component, l.life order by w.flown_from desc, w.action desc
        ) = 1
)

select
    m.*,
    a.msn,
    w.answered_by,
    w.matched_by,
    w.note
from tables.raw_messages as m
left join tables.components as c on m.code = c.message_code
left join flights as f on m.operator = f.operator and m.flight_id = f.flight_id
left join works as w
    on
        m.operator = w.operator
        and m.tail = w.tail
        and m.pack = w.pack
        and c.component = w.component
        and coalesce(f.departed_at, m.message_time) >= w.end_departed_at
        and coalesce(f.departed_at, m.message_time) < w.next_departed_at
left join airframes as a on m.operator = a.operator and m.tail = a.tail;
