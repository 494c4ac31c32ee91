-- Do the three residuals close? sensor - twin = (sensor - model) + (model - twin)
-- A fault: a flight and signal where they do not, over the same samples. Reads: residuals.
with wide as (
    select
        operator,
        tail,
        flight_id,
        pack,
        signal,
        max(mean) filter (where kind = 'sensor_minus_dsm') as sensor_minus_dsm,
        max(mean) filter (where kind = 'dsm_minus_twin') as dsm_minus_twin,
        max(mean) filter (where kind = 'sensor_minus_twin') as sensor_minus_twin,
        max(rms) as scale,
        min(n) = max(n) as same_samples
    from residuals
    group by operator, tail, flight_id, pack, signal
)

select
    operator,
    tail,
    flight_id,
    pack,
    signal,
    sensor_minus_dsm,
    dsm_minus_twin,
    sensor_minus_twin
from wide
where same_samples and abs(sensor_minus_dsm + dsm_minus_twin - sensor_minus_twin) > 1e-6 * scale + 1e-12;
