-- Which work was done, when and where, as the flights show it or else as the log has it?
-- Lines that are listed twice, that the flights do not show, or that wait for a flight are left out.
-- pack: pack worked on, by the flights
-- counts_from: flights that depart from then on count as flown after it
-- is_judged: the flights were asked, as they are of work that lowers a loss
-- Grain: operator, tail, pack, component, action, counts_from, reference, finding.
-- Reads: tables.raw_maintenance, tables.features_work.
create or replace view settled_work as
select
    operator,
    tail,
    position as pack,
    component,
    action,
    finding,
    reference,
    done_on,
    flown_from as counts_from,
    since_night,
    true as is_judged
from tables.features_work
where in_force
union all
select
    m.operator,
    m.tail,
    m.pack,
    m.component,
    m.action,
    m.finding,
    m.reference,
    m.done_on,
    m.counts_from,
    m.since_night,
    false as is_judged
from tables.raw_maintenance as m
anti join tables.features_work as w
    on
        m.operator = w.operator
        and m.tail = w.tail
        and m.pack = w.pack
        and m.component = w.component
        and m.action = w.action
        and m.counts_from = w.counts_from;
