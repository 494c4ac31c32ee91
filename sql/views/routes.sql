-- What do loss and margin do on each route, and in which air?
-- Without origin and destination only the air is given. Compare bins of one route, or routes within one bin: hot air
-- takes margin from a sound exchanger, too.
-- ambient_k: lower end of a bin of 10 K of the total air temperature in cruise; NULL where that is not known [K]
-- n_packs: packs that flew it
-- n_flights: flights of packs, each pack counted
-- hx_fouling: median loss after the flight [-]
-- gained_per_100_flights: mean gain of loss over the flight before, times a hundred, ten flights around work on the
-- pack or a recovery left out [1/100 flights]
-- gained_sd_per_100_flights: standard error of that mean [1/100 flights]
-- margin_k: median margin [K]
-- margin_worst_tenth_k: margin that a tenth of the flights stay below [K]
-- margin_ambient_k: median of what the air outside adds to the margin [K]
-- door_median: median ram door position in cruise [-]
-- Grain: operator, origin, destination, ambient_k. Reads: features, flights, unit_renewals.
create or replace view routes as
with renewed as (
    select distinct
        f.operator,
        f.flight_id,
        f.pack
    from unit_renewals as w
    asof inner join features as f
        on w.operator = f.operator and w.tail = f.tail and w.pack = f.pack and w.flown_from <= f.departed_at
),

followed as (
    select
        f.*,
        lag(f.hx_fouling) over own as last_fouling,
        count(r.flight_id) over (own rows between 10 preceding and 10 following) as n_renewals_near
    from features as f
    left join renewed as r on f.operator = r.operator and f.flight_id = r.flight_id and f.pack = r.pack
    window own as (partition by f.operator, f.tail, f.pack order by f.departed_at asc, f.flight_id asc)
),

flown as (
    select
        f.operator,
        f.tail,
        f.pack,
        k.origin,
        k.destination,
        10 * floor(f.tat_cruise_k / 10) as ambient_k,
        f.hx_fouling,
        case when f.n_renewals_near = 0 then f.hx_fouling - f.last_fouling end as gained,
        f.hx_margin_k,
        f.hx_margin_ambient_k,
        f.door_median
    from followed as f
    inner join flights as k on f.operator = k.operator and f.tail = k.tail and f.flight_id = k.flight_id
)

select
    operator,
    origin,
    destination,
    ambient_k,
    count(distinct tail || '/' || pack) as n_packs,
    count(*) as n_flights,
    median(hx_fouling) as hx_fouling,
    100 * avg(gained) as gained_per_100_flights,
    100 * stddev_samp(gained) / sqrt(count(gained)) as gained_sd_per_100_flights,
    median(hx_margin_k) as margin_k,
    quantile_cont(hx_margin_k, 0.1) as margin_worst_tenth_k,
    median(hx_margin_ambient_k) as margin_ambient_k,
    median(door_median) as door_median
from flown
group by operator, origin, destination, ambient_k;
