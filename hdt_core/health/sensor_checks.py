"""Sensor and ram door statistics, flight by flight: counts, cross checks, and the controller's schedules.

A cross check compares quantities that physics ties together, independent of the exchanger's wear: total and
compressor-inlet temperature, recorded and standard-atmosphere total pressure, the two flows of one pack, and left
against right where both controllers have the same target. None needs the digital system model.
"""

import polars as pl

from hdt_core.calibration.arrays import departure
from hdt_core.flight.channels import NO_CHANNELS, ONE_CHANNEL, count_gaps, lost_share
from hdt_core.flight.control_schedules import FULL_OPEN, ControlSchedules, has_authority, learn_schedules
from hdt_core.flight.cross_checks import ln_ratio
from hdt_core.flight.quality import RUNNING_KG_S, SHARED_SENSORS, reading_step
from hdt_core.physics.air import standard_pressure_pa, total_to_static_pressure
from hdt_core.records.keys import FLIGHT, LEG, join_other_pack
from hdt_core.tables.base import finite
from hdt_core.tables.raw import SIGNALS

PEG_BAND = 0.015
"""Samples within this of a flight's widest opening may rest on a stop: three sigma of the position sensor. [-]"""
CRUISE_MEDIANS = {
    "tat_k": "tat_cruise_k",
    "altitude_m": "altitude_cruise_m",
    "mach": "mach_cruise",
    "hx_in_k": "hx_in_cruise_k",
    "hx_out_k": "hx_out_cruise_k",
    "pack_flow_kg_s": "pack_flow_cruise_kg_s",
    "cc_speed_rad_s": "cc_speed_cruise_rad_s",
}
PAIRED_SIGNALS = (
    "tat_k", "total_pressure_pa", "hx_in_k", "hx_out_k", "pack_flow_kg_s", "cc_flow_kg_s", "cc_out_pa", "cc_out_k",
    "ram_door_open",
)  # fmt: skip
"""Signals compared with the other pack's of the same time."""
MIN_SAMPLES = 3
STILL_SAMPLES = 8
"""Readings below which one value may be chance and quantisation."""


LEAST_SPAN = dict.fromkeys(("tat_k", "hx_in_k", "hx_out_k", "cc_in_k", "cc_out_k"), 7.0) | {
    "ram_out_k": 4.0, "total_pressure_pa": 10_000.0, "cc_in_pa": 10_000.0, "cc_out_pa": 10_000.0,
    "pack_flow_kg_s": 0.05, "cc_flow_kg_s": 0.05, "cc_speed_rad_s": 500.0, "ram_door_open": 0.02, "vda_counts": 300.0,
}  # fmt: skip
"""Span of each signal over a flight that a sound sensor exceeds on 199 of 200; a coarser step may hide it."""


def cross_checks(
    samples: pl.DataFrame, schedules: ControlSchedules | None = None, channels: pl.DataFrame = NO_CHANNELS
) -> pl.DataFrame:
    """Compute counts, cross checks and door statistics of every flight and pack.

    Parameters
    ----------
    samples : DataFrame
        `legs_samples`: signals in SI with `phase`; invalid values are null. Snapshots with a phase serve as well.
    schedules : ControlSchedules, optional
        Of the controllers; learned from the first flights in `samples` where not given.
    channels : DataFrame, optional
        `legs_channels` of these flights: what the recorder withholds is not lost.

    Returns
    -------
    DataFrame
        One row a flight and pack: the key, `running` (pack on), `n_snapshots`; for each sensor `<signal>_lost_share`
        (empty values) and `<signal>_still` (one value all flight); for each cross check `w_<name>` (median) and
        `w_<name>_n`; for the door `door_span` (5 to 95 % of its travel in the flight), `door_max`, `door_peg_excess_k`
        (outlet above target where the door is widest, less the same elsewhere) with its two counts; and the flight's
        conditions: cruise medians, door effort, hours.
    """
    scheduled = _with_schedules(samples, schedules or learn_schedules(samples))
    whole = join_other_pack(scheduled, PAIRED_SIGNALS, ("time_utc", "source"))
    level = _with_pitot(whole.filter(pl.col("phase") == "cruise"))
    counts = whole.group_by(LEG).agg(*_counts(), *_door(), departure(samples).alias("departed_at"))
    out = _without_withheld(_without_coarse(counts, samples), channels)
    parts = (
        level.group_by(LEG).agg(*_checks(LEVEL_CHECKS), *_setting()),
        whole.group_by(LEG).agg(*_checks(FLIGHT_CHECKS)),
        _peg_excess(whole),
    )
    for part in parts:
        out = out.join(part, on=LEG, how="left", validate="m:1")
    return finite(out.sort(LEG))


def _counts() -> list[pl.Expr]:
    """Return empty and motionless sensors, and whether the pack runs, without which they mean nothing."""
    flows = [(pl.col(c).median() > RUNNING_KG_S).fill_null(False) for c in ("pack_flow_kg_s", "cc_flow_kg_s")]
    lost_share = [(pl.col(c).null_count() / pl.len()).alias(f"{c}_lost_share") for c in SIGNALS]
    still = [
        ((pl.col(c).max() == pl.col(c).min()) & (pl.col(c).count() >= STILL_SAMPLES)).alias(f"{c}_still")
        for c in SIGNALS
    ]
    return [pl.any_horizontal(flows).alias("running"), pl.len().alias("n_snapshots"), *lost_share, *still]


def _without_coarse(counts: pl.DataFrame, samples: pl.DataFrame) -> pl.DataFrame:
    """Take back `<signal>_still` where the recorder's step may hide what the signal did, or both packs stand still."""
    still = {s: pl.col(f"{s}_still") for s in LEAST_SPAN}
    flights = counts.filter(pl.any_horizontal(still.values())).select(FLIGHT).unique()
    if flights.is_empty():
        return counts
    snapshots = samples.filter(pl.col("source") == "acms").join(flights, on=FLIGHT, how="semi")
    steps = snapshots.group_by(FLIGHT).agg(reading_step(s).alias(f"step_{s}") for s in LEAST_SPAN)
    rows = counts.join(steps, on=FLIGHT, how="left", validate="m:1")
    # two sensors of one kind do not stop on one flight; air data may be one sensor's
    on_both = {s: (flag.sum().over(FLIGHT) > 1) & (s not in SHARED_SENSORS) for s, flag in still.items()}
    hidden = {s: (pl.col(f"step_{s}") >= LEAST_SPAN[s]).fill_null(False) | on_both[s] for s in LEAST_SPAN}
    return rows.with_columns((still[s] & ~hidden[s]).alias(f"{s}_still") for s in LEAST_SPAN).select(counts.columns)


def _without_withheld(counts: pl.DataFrame, channels: pl.DataFrame) -> pl.DataFrame:
    """Leave regular gaps out of `<signal>_lost_share`; null it where both packs' readings are one channel."""
    shared = channels.filter(reason=ONE_CHANNEL).group_by(LEG).agg(
        (pl.col("signal") == s).any().alias(f"shared_{s}") for s in SIGNALS
    )  # fmt: skip
    if channels.is_empty():
        return counts
    rows = counts
    for part in (count_gaps(channels), shared):
        rows = rows.join(part, on=LEG, how="left", validate="1:1")
    n = pl.col("n_snapshots")
    shares = {s: lost_share(s, (pl.col(f"{s}_lost_share") * n).round(), n) for s in SIGNALS}
    own = {s: ~pl.col(f"shared_{s}").fill_null(False) for s in SIGNALS}
    return rows.with_columns(
        pl.when(own[s]).then(share).alias(f"{s}_lost_share") for s, share in shares.items()
    ).select(counts.columns)  # fmt: skip


def _door() -> list[pl.Expr]:
    door = pl.col("ram_door_open")
    return [
        (door.quantile(0.95) - door.quantile(0.05)).alias("door_span"),
        door.max().alias("door_max"),
        door.count().alias("door_n"),
        door.diff().abs().sum().alias("door_travel"),
        ((pl.col("time_utc").max() - pl.col("time_utc").min()).dt.total_seconds() / 3600.0).alias("flight_hours"),
    ]


def _setting() -> list[pl.Expr]:
    """Return the conditions of the cruise."""
    door = pl.col("ram_door_open")
    median = [pl.col(c).median().alias(name) for c, name in CRUISE_MEDIANS.items()]
    return [*median, door.median().alias("door_median"), (door > FULL_OPEN).mean().alias("door_full_open_share")]


def _with_schedules(samples: pl.DataFrame, schedules: ControlSchedules) -> pl.DataFrame:
    """Add the scheduled parts of outlet temperature and exit pressure."""
    tail = samples["tail"].to_numpy()
    tat_k, altitude_m, flow = (samples[c].to_numpy().astype(float) for c in ("tat_k", "altitude_m", "pack_flow_kg_s"))
    return samples.with_columns(
        schedules.outlet.column(tail, tat_k).alias("target_shape_k"),
        schedules.delivery.column(tail, altitude_m, flow**2).alias("delivery_shape_ln"),
    )


def _with_pitot(level: pl.DataFrame) -> pl.DataFrame:
    """Add the total pressure by pressure altitude and Mach number."""
    pitot_pa = standard_pressure_pa(level["altitude_m"].to_numpy()) * total_to_static_pressure(level["mach"].to_numpy())
    return level.with_columns(pl.Series("pitot_pa", pitot_pa).fill_nan(None))


_BOTH_RUN = (pl.col("pack_flow_kg_s") > RUNNING_KG_S) & (pl.col("other_pack_flow_kg_s") > RUNNING_KG_S)

LEVEL_CHECKS: dict[str, pl.Expr] = {
    "inlet_minus_tat_k": pl.col("cc_in_k") - pl.col("tat_k"),
    "inlet_over_total_pressure_ln": ln_ratio("cc_in_pa", "total_pressure_pa"),
    "total_over_pitot_pressure_ln": ln_ratio("total_pressure_pa", "pitot_pa"),
    "pack_over_compressor_flow_ln": ln_ratio("pack_flow_kg_s", "cc_flow_kg_s", RUNNING_KG_S),
    "tat_between_packs_k": pl.col("tat_k") - pl.col("other_tat_k"),
    "total_pressure_between_packs_ln": ln_ratio("total_pressure_pa", "other_total_pressure_pa"),
    "pack_flow_between_packs_ln": ln_ratio("pack_flow_kg_s", "other_pack_flow_kg_s", RUNNING_KG_S),
    "compressor_flow_between_packs_ln": ln_ratio("cc_flow_kg_s", "other_cc_flow_kg_s", RUNNING_KG_S),
    "cc_out_pressure_between_packs_ln": pl.when(_BOTH_RUN).then(ln_ratio("cc_out_pa", "other_cc_out_pa")),
    "cc_out_pressure_over_schedule_ln": pl.when(
        (pl.col("cc_out_pa") > 0) & (pl.col("pack_flow_kg_s") > RUNNING_KG_S)
    ).then(pl.col("cc_out_pa").log() - pl.col("delivery_shape_ln")),
    "hx_in_between_packs_k": pl.when(_BOTH_RUN).then(pl.col("hx_in_k") - pl.col("other_hx_in_k")),
    "cc_out_between_packs_k": pl.when(_BOTH_RUN).then(pl.col("cc_out_k") - pl.col("other_cc_out_k")),
}
"""Cross checks in cruise; each is constant up to noise while its sensors are sound."""

_ABOVE_TARGET_K = pl.col("hx_out_k") - pl.col("target_shape_k")
FLIGHT_CHECKS: dict[str, pl.Expr] = {
    "hx_out_minus_target_k": pl.when(has_authority()).then(_ABOVE_TARGET_K),
    # both controllers have the same target, whatever the wear
    "hx_out_between_packs_k": pl.when(has_authority() & has_authority("other_")).then(
        pl.col("hx_out_k") - pl.col("other_hx_out_k")
    ),
}
"""Cross checks of the controllers, which are fast enough for climb and descent."""

CHECKS = (*LEVEL_CHECKS, *FLIGHT_CHECKS)


def _checks(checks: dict[str, pl.Expr]) -> list[pl.Expr]:
    """Return the median of each check, null below three samples, and its count."""
    medians = [pl.when(e.count() >= MIN_SAMPLES).then(e.median()).alias(f"w_{name}") for name, e in checks.items()]
    return medians + [e.count().alias(f"w_{name}_n") for name, e in checks.items()]


def _peg_excess(whole: pl.DataFrame) -> pl.DataFrame:
    """Compute the outlet above target at the door's widest opening less elsewhere, without the flight's trim."""
    at_stop = pl.col("ram_door_open") > pl.col("ram_door_open").max().over(LEG) - PEG_BAND
    above = pl.when(has_authority()).then(_ABOVE_TARGET_K)
    return whole.group_by(LEG).agg(
        (above.filter(at_stop).median() - above.filter(~at_stop).median()).alias("door_peg_excess_k"),
        above.filter(at_stop).count().alias("door_peg_n"),
        above.filter(~at_stop).count().alias("door_off_peg_n"),
        # large behind a jammed door, which leaves the outlet now above, now below its target
        above.std().alias("hx_out_target_sd_k"),
    )
