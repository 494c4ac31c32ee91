-- Which units were found without a fault since their aircraft last flew, or by an entry since the last night?
-- Their forecast is of the loss that the inspection did not find.
-- found_clean_on: day of the inspection; of several the last
-- Grain: operator, tail, pack, component. Reads: flight_rates, tables.raw_maintenance.
create or replace view clean_units as
select
    m.operator,
    m.tail,
    m.pack,
    m.component,
    max(m.done_on) as found_clean_on
from tables.raw_maintenance as m
inner join flight_rates as f
    on
        m.operator = f.operator
        and m.tail = f.tail
        and (m.counts_from > f.last_departed_at or m.since_night)
where m.action = 'INSPECTED' and m.finding = 'NO_FAULT_FOUND' and m.pack is not null
group by m.operator, m.tail, m.pack, m.component;
