-- Which heat exchangers were fitted, for how long, and how fast did each foul?
-- A unit's life runs from one replacement in the log to the next. Its last six flights, which may be the next unit's,
-- do not count towards its slope: the log may be late.
-- serial: serial number of the unit, where the log gives it
-- came_from: operator, tail and pack where a unit of this serial number flew before, NULL where it did not
-- unit: number of the exchanger in that place, 0 for the one fitted when the record begins
-- installed_on: day of the log on which it came, NULL where the record begins with it
-- removed_on: day of the log on which it went, NULL while it is fitted
-- first_flight_at: departure of its first flight on record
-- last_flight_at: departure of its last flight on record
-- n_flights: flights on record with an estimate
-- first_hx_fouling: fouling after its first flight on record [-]
-- greatest_hx_fouling: greatest fouling of its life [-]
-- fouling_per_100_flights: slope of the fouling, times a hundred [1/100 flights]
-- Grain: operator, tail, pack, unit (from 0). Reads: health_parameters, tables.raw_maintenance.
create or replace view exchanger_lives as
with removals as (
    select
        operator,
        tail,
        pack,
        counts_from,
        any_value(done_on) as done_on,
        any_value(finding) as finding,
        any_value(serial_on) as serial_on,
        any_value(serial_off) as serial_off
    from tables.raw_maintenance
    where component = 'HX' and action = 'REPLACED' and pack is not null
    group by operator, tail, pack, counts_from
),

flown as (
    select
        h.operator,
        h.tail,
        h.pack,
        h.flight_id,
        h.departed_at,
        h.value as hx_fouling,
        count(r.counts_from) as unit,
        max(r.done_on) as installed_on,
        arg_max(r.serial_on, r.counts_from) as serial_on
    from health_parameters as h
    left join removals as r
        on
            h.operator = r.operator
            and h.tail = r.tail
            and h.pack = r.pack
            and h.departed_at >= r.counts_from
    where h.parameter = 'hx_fouling' and h.value is not null
    group by h.operator, h.tail, h.pack, h.flight_id, h.departed_at, h.value
),

numbered as (
    select
        *,
        row_number() over (partition by operator, tail, pack, unit order by departed_at asc) as flight_of_unit,
        row_number() over (partition by operator, tail, pack, unit order by departed_at desc) as flight_from_end
    from flown
),

lives as (
    select
        operator,
        tail,
        pack,
        unit,
        any_value(installed_on) as installed_on,
        any_value(serial_on) as serial_on,
        min(departed_at) as first_flight_at,
        max(departed_at) as last_flight_at,
        count(*) as n_flights,
        arg_min(hx_fouling, flight_of_unit) as first_hx_fouling,
        max(hx_fouling) as greatest_hx_fouling,
        100 * regr_slope(hx_fouling, flight_of_unit) filter (where flight_from_end > 6) as fouling_per_100_flights
    from numbered
    group by operator, tail, pack, unit
)

select
    l.operator,
    l.tail,
    l.pack,
    l.unit,
    l.installed_on,
    r.done_on as removed_on,
    r.finding,
    l.first_flight_at,
    l.last_flight_at,
    l.n_flights,
    l.first_hx_fouling,
    l.greatest_hx_fouling,
    l.fouling_per_100_flights,
    coalesce(l.serial_on, r.serial_off) as serial,
    case
        when serial is not null
            then lag(l.operator || ' ' || l.tail || ' ' || l.pack)
                over (partition by serial order by l.first_flight_at asc)
    end as came_from
from lives as l
asof left join removals as r
    on
        l.operator = r.operator
        and l.tail = r.tail
        and l.pack = r.pack
        and l.last_flight_at < r.counts_from;
