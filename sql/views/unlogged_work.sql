-- Which parts recovered as after a wash or a replacement, though the log has no such work?
-- Enter the work, or look for the sensor that shifted: until then the unit's age and its wear before count as one life.
-- Work from a week before to a week after the flights of a recovery explains it, by its date or where it settled.
-- Grain: operator, tail, pack, component, flight_id. Reads: recoveries, tables.raw_maintenance,
-- settled_work.
create or replace view unlogged_work as
select
    r.operator,
    r.tail,
    r.pack,
    r.component,
    r.flight_id,
    r.departed_at,
    r.loss_before,
    r.loss,
    r.loss_sd
from recoveries as r
anti join tables.raw_maintenance as m
    on
        r.operator = m.operator
        and r.tail = m.tail
        and r.pack = m.pack
        and r.component = m.component
        and m.action in ('REPLACED', 'CLEANED')
        and m.done_on between (r.since at time zone 'UTC')::date - 7 and (r.departed_at at time zone 'UTC')::date + 7
anti join settled_work as w
    on
        r.operator = w.operator
        and r.tail = w.tail
        and r.pack = w.pack
        and r.component = w.component
        and w.action in ('REPLACED', 'CLEANED')
        and w.counts_from between r.since - interval 7 days and r.departed_at + interval 7 days;
