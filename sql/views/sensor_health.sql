-- What share of each sensor's readings was recorded, and what share of those passed the screens?
-- month: first day of the month (UTC)
-- signal: column of the recorder's signals
-- n_snapshots: snapshots of the pack
-- n_recorded: of these, with a value
-- n_believed: of these, left by the screens for spikes, frozen and impossible values
-- recorded_share: n_recorded over n_snapshots [-]
-- believed_share: n_believed over n_recorded [-]
-- Grain: operator, tail, pack, month, signal. Reads: tables.raw_snapshots, tables.legs_samples.
create or replace view sensor_health as
with samples as (
    select
        *,
        true as as_recorded
    from tables.raw_snapshots
    union all by name
    select
        *,
        false as as_recorded
    from tables.legs_samples
    where source = 'acms'
),

counted as (
    select
        operator,
        tail,
        pack,
        signal,
        date_trunc('month', time_utc at time zone 'UTC')::date as month,
        count(*) filter (where as_recorded) as n_snapshots,
        count(reading) filter (where as_recorded) as n_recorded,
        count(reading) filter (where not as_recorded) as n_believed
    from samples
    unpivot include nulls (
        reading for signal in (
            altitude_m,
            mach,
            tat_k,
            total_pressure_pa,
            hx_in_k,
            hx_out_k,
            ram_door_open,
            pack_flow_kg_s,
            ram_out_k,
            cc_speed_rad_s,
            cc_in_k,
            cc_in_pa,
            cc_out_k,
            cc_out_pa,
            cc_flow_kg_s,
            vda_counts
        )
    )
    group by operator, tail, pack, signal, month
)

select
    operator,
    tail,
    pack,
    month,
    signal,
    n_snapshots,
    n_recorded,
    n_believed,
    n_recorded / n_snapshots as recorded_share,
    n_believed / nullif(n_recorded, 0) as believed_share
from counted
where n_snapshots > 0;
