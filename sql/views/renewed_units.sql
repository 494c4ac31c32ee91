-- Which units were washed or replaced since their aircraft last flew, or by an entry since the last night?
-- What the last night estimated does not show how they are now: loss, flights left, chance, date and cost are null
-- until a night has a flight after the work.
-- work_action: CLEANED or REPLACED; of several the last
-- work_on: day of that work
-- reference: work order
-- Grain: operator, tail, pack, component. Reads: flight_rates, settled_work.
create or replace view renewed_units as
select
    m.operator,
    m.tail,
    m.pack,
    m.component,
    m.action as work_action,
    m.done_on as work_on,
    m.reference
from settled_work as m
inner join flight_rates as f
    on
        m.operator = f.operator
        and m.tail = f.tail
        and (m.counts_from > f.last_departed_at or m.since_night)
where m.action in ('REPLACED', 'CLEANED') and m.pack is not null
qualify
    row_number() over (
        partition by m.operator, m.tail, m.pack, m.component order by m.done_on desc, m.action desc
    ) = 1;
