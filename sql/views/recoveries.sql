-- Where did the loss of a part recover as after a wash or a replacement?
-- A recovery is a loss lower than ten flights before, by a twentieth or more and by three standard deviations or more.
-- flight_id: first flight of the recovery
-- fell_at: departure of the flight on which it fell most, up to nine flights before
-- since: departure of the flight ten before
-- loss_before: loss ten flights before [-]
-- loss: loss after this flight [-]
-- loss_sd: standard deviation of it [-]
-- Grain: operator, tail, pack, component, flight_id. Reads: health_parameters, tables.components.
create or replace view recoveries as
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
        h.value - lag(h.value) over own as step,
        row_number() over own as flight_number
    from health_parameters as h
    inner join tables.components as c on h.component = c.component and h.parameter = c.loss
    where h.value is not null
    window
        own as (partition by h.operator, h.tail, h.pack, h.component order by h.departed_at, h.flight_id),
        ten_before as (own rows between 10 preceding and 10 preceding)
),

fallen as (
    select
        *,
        arg_min(departed_at, step) over (
            partition by operator, tail, pack, component
            order by flight_number rows between 9 preceding and current row
        ) as fell_at
    from tracks
),

numbered as (
    select
        *,
        flight_number - lag(flight_number) over (
            partition by operator, tail, pack, component order by flight_number
        ) as flights_since_last
    from fallen
    where loss_before - loss >= greatest(0.05, 3 * sqrt(loss_sd * loss_sd + sd_before * sd_before))
)

select * exclude (sd_before, step, flight_number, flights_since_last)
from numbered
where flights_since_last is null or flights_since_last > 20;
