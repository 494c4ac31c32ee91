-- Which parts recovered as after a wash or a replacement, though the log has no such work?
-- Enter the work, or look for the sensor that shifted: until then the unit's age and its wear before count as one life.
-- A recovery is a loss lower than ten flights before, by a twentieth or more and by three standard deviations or more;
-- work from a week before to a week after those flights explains it.
-- flight_id: first flight of the recovery
-- loss_before: loss ten flights before
-- loss: loss after this flight
-- loss_sd: standard deviation of it
-- Grain: operator, tail, pack, component, flight_id. Reads: health_parameters, tables.components,
-- tables.raw_maintenance.
create or replace view unlogged_work as
with tracks as (
    select
        h.operator,
        h.tail,
        h.pack,
        h.component,
        h.flight_id,
        h.departed_at,
        h.value as loss,
        h.sd as loss_sd,
        any_value(h.value) over ten_before as loss_before,
        any_value(h.sd) over ten_before as sd_before,
        any_value(h.departed_at) over ten_before as since,
        row_number() over own as flight_number
    from health_parameters as h
    inner join tables.components as c on h.component = c.component and h.parameter = c.loss
    where h.value is not null
    window
        own as (partition by h.operator, h.tail, h.pack, h.component order by h.departed_at, h.flight_id),
        ten_before as (own rows between 10 preceding and 10 preceding)
),

recoveries as (
    select
        *,
        flight_number - lag(flight_number) over (
            partition by operator, tail, pack, component order by flight_number
        ) as flights_since_last
    from tracks
    where loss_before - loss >= greatest(0.05, 3 * sqrt(loss_sd * loss_sd + sd_before * sd_before))
)

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
where r.flights_since_last is null or r.flights_since_last > 20;
