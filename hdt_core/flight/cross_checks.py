"""Cross checks between sensors, leg by leg, with later flights too: differences that physics keeps constant.

The exchanger's wear shifts none of them, and only the twin's checks need a model of it.
"""

import polars as pl

from hdt_core.flight.control_schedules import ControlSchedule, has_authority
from hdt_core.flight.quality import RUNNING_KG_S
from hdt_core.records.keys import FLIGHT, LEG, PACK, join_other_pack
from hdt_core.robust import MEDIAN_SD, spread_expr

SMOOTHED_FLIGHTS = 7  # of the running medians of checks and conductance
FAULT_SD = 4.0  # of the smoothed check's noise on the pack
SINGLE_FLIGHT = 2.5  # times the tolerance: so far off, one flight is enough
SAMPLE_COLUMNS = (
    *LEG, "time_utc", "source", "phase", "tat_k", "total_pressure_pa", "hx_out_k", "ram_door_open", "pack_flow_kg_s",
    "cc_in_k", "cc_in_pa", "cc_flow_kg_s",
)  # fmt: skip
"""Columns of the samples that the checks use."""

# check: shift [its unit] below which a sound pair of sensors may wander (humidity, leaks, trim): about half of a
# fault's size
TOLERANCE = {
    "outlet_between_packs_k": 1.2,
    "inlet_minus_tat_k": 0.8,
    "inlet_over_total_pressure_ln": 0.015,
    "pack_over_compressor_flow_ln": 0.030,
    "pack_flow_between_packs_ln": 0.045,
    "inlet_apart_k": 2.5,  # a blockage of 15 % shifts it by 1.5 K
    "door_apart_ln": 0.06,
}
INLET_SHARE = 0.7
"""Part of the hot inlet sensor's error that its check shows: the law warms the air by the same reading. [-]"""
TWIN_CHECKS = ("inlet_apart_k", "door_apart_ln")
"""Of the twin's flights (`hdt_core.tracking.sensor_shifts`); null before a first calibration."""
BETWEEN_PACKS = {"outlet_between_packs_k": "outlet_above_law_k", "pack_flow_between_packs_ln": "pack_flow_ln"}
LEG_CHECKS = (*(c for c in TOLERANCE if c not in TWIN_CHECKS), *BETWEEN_PACKS.values())
CHECKS = (*LEG_CHECKS, *TWIN_CHECKS)
USUAL_SHARE = 0.25  # of the tolerance: nearer to its level than this a check has not left it, however steady it is


def check_sensors(values: pl.DataFrame, legs: pl.DataFrame) -> pl.DataFrame:
    """Detect sensor shifts, leg by leg.

    Parameters
    ----------
    values : DataFrame
        Of `leg_checks`, all flights of each tail, with `TWIN_CHECKS`; a missing check is skipped.
    legs : DataFrame
        `LEG` and `flight_number`.

    Returns
    -------
    DataFrame
        `LEG`, `sensor_shift` (bool), `sensor_check`, the check with the largest shift (null if none),
        and `<check>_off`, the leg's own deviation.

    Notes
    -----
    Each check is the leg's mean of a difference that is constant for sound sensors, less its median over the tail's
    flights: sensor faults are repaired, so most flights are sound. It has shifted where its running median over seven
    flights leaves zero by more than a tolerance and by four standard deviations of its noise, or one flight by far
    more. A check between packs flags both, except the pack whose own reading is clearly nearer to its schedule.
    A drift begins before it is detectable: all flights of the period are flagged, from where the running median left
    its usual scatter until it returned.
    """
    absent = (pl.lit(None, pl.Float64).alias(c) for c in CHECKS if c not in values.columns)
    rows = values.with_columns(absent).join(legs.select(*LEG, "flight_number"), on=LEG, validate="m:1")
    off = rows.sort(*PACK, "flight_number").with_columns(pl.col(c) - pl.col(c).median().over(PACK) for c in CHECKS)
    smooth = off.with_columns(
        pl.col(c).rolling_median(SMOOTHED_FLIGHTS, center=True, min_samples=3).over(PACK).alias(f"{c}_smooth")
        for c in CHECKS
    )
    parts = smooth.with_columns(_scatters()).with_columns(
        e for c in TOLERANCE for e in (_side(c), _shift(c), _is_of_other_pack(c))
    )
    scores = parts.with_columns(_score(c).alias(f"{c}_score") for c in TOLERANCE)
    worst = pl.max_horizontal(pl.col(f"{c}_score") for c in TOLERANCE).fill_null(0.0)
    check_name = pl.coalesce(
        pl.when((pl.col(f"{c}_score") == worst) & (worst > 1.0)).then(pl.lit(c)) for c in TOLERANCE
    )
    deviations = [pl.col(c).fill_null(0.0).alias(f"{c}_off") for c in TOLERANCE]
    return scores.select(*LEG, (worst > 1.0).alias("sensor_shift"), check_name.alias("sensor_check"), *deviations)


def _scatters() -> list[pl.Expr]:
    """Return the scatter of each check: `_step` between flights, `_alone` of single flights, `_smooth_usual`."""
    checks = pl.col(list(TOLERANCE))
    smooth = pl.col([f"{c}_smooth" for c in TOLERANCE])
    values = {"_step": checks.diff(), "_alone": checks, "_usual": smooth}
    return [spread_expr(v).over(PACK).name.suffix(end) for end, v in values.items()]


def _side(check: str) -> pl.Expr:
    """Return the sign of the smoothed check where it has left its level, else 0."""
    smooth = pl.col(f"{check}_smooth").forward_fill().over(PACK)
    outside = smooth.abs() > pl.max_horizontal(f"{check}_smooth_usual", pl.lit(USUAL_SHARE * TOLERANCE[check]))
    return pl.when(outside).then(smooth.sign()).otherwise(0.0).alias(f"{check}_side")


def _shift(check: str) -> pl.Expr:
    """Return the smoothed check over its allowance; noise is of steps between flights, which a drift does not raise."""
    noise = MEDIAN_SD * pl.col(f"{check}_step") / (2.0 * SMOOTHED_FLIGHTS) ** 0.5
    allowance = pl.max_horizontal(noise * FAULT_SD, pl.lit(TOLERANCE[check]))
    return (pl.col(f"{check}_smooth").abs() / allowance).alias(f"{check}_shift")


def _is_of_other_pack(check: str) -> pl.Expr:
    """Flag a shift of the other pack: this one's own reading is clearly nearer to its schedule."""
    name = f"{check}_other"
    if check not in BETWEEN_PACKS:
        return pl.lit(False).alias(name)
    offset = pl.col(f"{BETWEEN_PACKS[check]}_smooth").abs()
    return (offset < 0.5 * offset.max().over(FLIGHT)).fill_null(False).alias(name)


def _score(check: str) -> pl.Expr:
    """Return the shift over its allowance, of the flight alone or the largest of its period; above 1 it is a fault."""
    side, shift, other = (pl.col(f"{check}_{part}") for part in ("side", "shift", "other"))
    period = pl.struct(*PACK, side).rle_id()
    lasting = pl.when(side != 0.0).then(shift.max().over(period)).otherwise(shift)
    is_of_other = pl.when(side != 0.0).then(other.sort_by(shift).last().over(period)).otherwise(other)
    alone = pl.col(f"{check}_alone") * FAULT_SD
    single = pl.col(check).abs() / pl.max_horizontal(alone, pl.lit(SINGLE_FLIGHT * TOLERANCE[check]))
    return pl.max_horizontal(pl.when(~is_of_other).then(lasting), pl.when(~other).then(single))


def leg_checks(samples: pl.DataFrame, outlet: ControlSchedule | None) -> pl.DataFrame:
    """Average each check over the leg: `LEG`, `LEG_CHECKS`.

    Parameters
    ----------
    samples : DataFrame
        Screened samples of both packs with `phase`.
    outlet : ControlSchedule, optional
        Of the outlet temperature; without it a check between packs flags both.
    """
    running = samples.select(SAMPLE_COLUMNS).filter(pl.col("pack_flow_kg_s") > RUNNING_KG_S)
    target_k = outlet.column(running["tail"].to_numpy(), running["tat_k"].to_numpy()) if outlet else pl.lit(None)
    rows = running.with_columns(target_k.cast(pl.Float64).alias("target_k"))
    pairs = join_other_pack(rows, ("hx_out_k", "ram_door_open", "pack_flow_kg_s"), ("time_utc", "source"))
    both_free = has_authority() & has_authority("other_")
    cruise = pl.col("phase") == "cruise"
    return pairs.group_by(LEG).agg(
        (pl.col("hx_out_k") - pl.col("other_hx_out_k")).filter(both_free).mean().alias("outlet_between_packs_k"),
        (pl.col("hx_out_k") - pl.col("target_k")).filter(both_free).mean().alias("outlet_above_law_k"),
        (pl.col("cc_in_k") - pl.col("tat_k")).mean().alias("inlet_minus_tat_k"),
        ln_ratio("cc_in_pa", "total_pressure_pa").filter(cruise).mean().alias("inlet_over_total_pressure_ln"),
        ln_ratio("pack_flow_kg_s", "cc_flow_kg_s").filter(cruise).mean().alias("pack_over_compressor_flow_ln"),
        ln_ratio("pack_flow_kg_s", "other_pack_flow_kg_s").filter(cruise).mean().alias("pack_flow_between_packs_ln"),
        pl.col("pack_flow_kg_s").log().filter(cruise).mean().alias("pack_flow_ln"),
    )


def ln_ratio(top: str, bottom: str, least: float = 0.0) -> pl.Expr:
    """Return the ln ratio of two readings; null where one is missing or not above `least`."""
    good = (pl.col(top) > least) & (pl.col(bottom) > least)
    return pl.when(good).then((pl.col(top) / pl.col(bottom)).log())
