-- How much of what each sensor should have said was recorded, and how much of that could be believed?
-- month: first day of the month (UTC)
-- signal: column of the recorder's signals
-- n_snapshots: snapshots of the pack
-- n_recorded: of these, with a value
-- n_believed: of these, left by the screens for spikes, frozen and impossible values
-- recorded_share: n_recorded over n_snapshots [-]
-- believed_share: n_believed over n_recorded [-]
-- Grain: operator, tail, pack, month, signal. Reads: tables.raw_snapshots, tables.legs_samples.
create or replace view sensor_health as
with signals as (
    select unnest([
        'altitude_m',
        'mach',
        'tat_k',
        'total_pressure_pa',
        'hx_in_k',
        'hx_out_k',
        'ram_door_open',
        'pack_flow_kg_s',
        'ram_out_k',
        'cc_speed_rad_s',
        'cc_in_k',
        'cc_in_pa',
        'cc_out_k',
        'cc_out_pa',
        'cc_flow_kg_s',
        'vda_counts'
    ]) as signal
),

asked as (
    select
        operator,
        tail,
        pack,
        date_trunc('month', time_utc at time zone 'UTC')::date as month,
        count(*) as n_snapshots
    from tables.raw_snapshots
    group by operator, tail, pack, month
),

recorded as (
    select
        operator,
        tail,
        pack,
        signal,
        date_trunc('month', time_utc at time zone 'UTC')::date as month,
        count(*) as n_recorded
    from tables.raw_snapshots
    unpivot (
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
),

snapshots as (
    select *
    from tables.legs_samples
    where source = 'acms'
),

believed as (
    select
        operator,
        tail,
        pack,
        signal,
        date_trunc('month', time_utc at time zone 'UTC')::date as month,
        count(*) as n_believed
    from snapshots
    unpivot (
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
    a.operator,
    a.tail,
    a.pack,
    a.month,
    s.signal,
    a.n_snapshots,
    coalesce(r.n_recorded, 0) as n_recorded,
    coalesce(b.n_believed, 0) as n_believed,
    coalesce(r.n_recorded, 0) / a.n_snapshots as recorded_share,
    b.n_believed / r.n_recorded as believed_share
from asked as a
cross join signals as s
left join recorded as r
    on
        a.operator = r.operator
        and a.tail = r.tail
        and a.pack = r.pack
        and a.month = r.month
        and s.signal = r.signal
left join believed as b
    on
        a.operator = b.operator
        and a.tail = b.tail
        and a.pack = b.pack
        and a.month = b.month
        and s.signal = b.signal;
