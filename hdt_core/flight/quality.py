"""Screens of single readings, and the step of a recorder: what no sound sensor reports, and what rounding hides."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from math import erf, inf, log, sqrt

import polars as pl

from hdt_core.flight.phases import number_legs, seconds_between
from hdt_core.records.keys import FLIGHT

# signal: (lowest, highest physical value, largest jump out of and back to its neighbours that a sound sensor makes)
LIMITS: dict[str, tuple[float, float, float]] = {
    "altitude_m": (-500.0, 15_500.0, 1_500.0),
    "mach": (0.0, 1.0, 0.06),
    "tat_k": (200.0, 335.0, 8.0),
    "total_pressure_pa": (12_000.0, 130_000.0, 8_000.0),
    "hx_in_k": (240.0, 560.0, 15.0),
    "hx_out_k": (240.0, 450.0, 8.0),
    "ram_door_open": (-0.02, 1.02, 0.35),
    "pack_flow_kg_s": (0.0, 3.0, 0.15),
    "ram_out_k": (220.0, 500.0, 12.0),
    "cc_speed_rad_s": (0.0, 8_000.0, 700.0),
    "cc_in_k": (200.0, 345.0, 8.0),
    "cc_in_pa": (8_000.0, 130_000.0, 8_000.0),
    "cc_out_k": (220.0, 560.0, 20.0),
    "cc_out_pa": (30_000.0, 300_000.0, 8_000.0),
    "cc_flow_kg_s": (0.0, 3.0, 0.20),
    "vda_counts": (-1.0, 4_200.0, 400.0),
}
SIGNALS = tuple(LIMITS)
RUNNING_KG_S = 0.2  # flow below which a pack is off

# noise exceeds resolution: the same reading six times over two minutes is a dead sensor, not a calm flight
NOISY = ("pack_flow_kg_s", "cc_flow_kg_s", "cc_speed_rad_s")
NOISY_RUN, NOISY_RUN_S, OFF_BELOW = 6, 120.0, 0.05
# bound to the air outside: [m] of climb or descent over which a sound sensor can't repeat its reading
SHARED_SENSORS = ("tat_k", "total_pressure_pa", "mach")  # both packs may record one and the same
FROZEN_RISE_M = dict.fromkeys(("total_pressure_pa", "cc_in_pa"), 1_000.0)
FROZEN_RISE_M |= dict.fromkeys(("tat_k", "cc_in_k", "hx_in_k", "hx_out_k", "cc_out_k"), 6_000.0)
# moved by a controller as the air outside changes: [m] of climb after which the same reading all flight is a dead
# sensor's; that of a jammed part still shows noise
STILL_RISE_M = {"ram_door_open": 6_000.0}
AT_STOP = 0.02  # of its travel from either end: there a sound part may stand all flight
# noise of a reading [signal's unit]: it carries a reading across a finer step
READING_SD = dict.fromkeys(("tat_k", "hx_in_k", "hx_out_k", "ram_out_k", "cc_in_k", "cc_out_k"), 0.35)
READING_SD |= {"cc_in_pa": 90.0, "total_pressure_pa": 90.0, "cc_out_pa": 280.0, "ram_door_open": 0.005}
READING_SD |= {"pack_flow_kg_s": 0.008, "cc_flow_kg_s": 0.012, "cc_speed_rad_s": 3.5, "vda_counts": 5.0}
COARSE_FLOW_KG_S = 0.042  # step of a flow whose rounding, step / sqrt(12), exceeds the noise of a reading
CHANCE_RUN = 1e-5  # chance of a run of equal readings at which it is none
# least change with altitude [signal's unit / m], by which a coarser step hides more of a climb
LEAST_GRADIENT = dict.fromkeys(("total_pressure_pa", "cc_in_pa"), 1.5)
LEAST_GRADIENT |= dict.fromkeys(("tat_k", "cc_in_k", "hx_in_k", "hx_out_k", "cc_out_k"), 0.001)


def null_bad_values(records: pl.DataFrame, *, by: Sequence[str]) -> pl.DataFrame:
    """Null values that no sound sensor can report, and count them.

    Parameters
    ----------
    records : DataFrame
        `by`, `time_utc` and the signals of `LIMITS`, sorted by `by` and time. A column that an operator does not record
        may be null throughout.

    Returns
    -------
    DataFrame
        The same rows with bad values null, and `n_out_of_range`, `n_spikes` and `n_frozen`: number of values of the
        row nulled by each screen.

    Notes
    -----
    A spike is a sample on the same side of both neighbours by more than the signal can change; a frozen value repeats
    where noise or the change of altitude must have changed it. The screens apply in turn.
    """
    rows = number_legs(records, by)
    rows = _null(rows, {s: _is_out_of_range(s) for s in SIGNALS}, "n_out_of_range")
    rows = _null(rows, {s: _is_spike(s) for s in SIGNALS}, "n_spikes")
    return _null_frozen(rows, [c for c in by if c != "pack"]).drop("_leg")


def _null_frozen(rows: pl.DataFrame, flight: Sequence[str]) -> pl.DataFrame:
    """Null frozen readings; of flights that seem to have some, with the steps of the recorder at hand."""
    flags = _frozen_flags()
    suspects = rows.filter(pl.any_horizontal(flags.values())).select(flight).unique()
    if suspects.is_empty():
        return rows.with_columns(pl.lit(0, pl.Int32).alias("n_frozen"))
    records = rows.join(suspects, on=flight, how="semi")
    steps = records.group_by(flight).agg(_step_of_packs(s).alias(s) for s in flags)
    limits = steps.with_columns(
        *(
            pl.Series(s, [run_of_chance(step or 0.0, READING_SD[s]) for step in steps[s]])
            for s in (*NOISY, *STILL_RISE_M)
        ),
        *(_hidden_rise_m(s) for s in FROZEN_RISE_M),
    ).rename({s: f"_limit_{s}" for s in flags})
    with_limits = rows.join(limits, on=flight, how="left", maintain_order="left", validate="m:1")
    flags = _frozen_flags({s: pl.col(f"_limit_{s}") for s in flags})
    return _null(with_limits, flags, "n_frozen").drop(f"_limit_{s}" for s in flags)


def _frozen_flags(limits: Mapping[str, pl.Expr] | None = None) -> dict[str, pl.Expr]:
    """Flag frozen readings of each signal that can be told: beyond the limits of the recorder's steps, if given."""
    limit = defaultdict(lambda: pl.lit(0.0), limits or {})
    return {
        **{s: _is_frozen_noisy(s, limit[s]) for s in NOISY},
        **{s: _is_frozen_in_climb(s, limit[s]) for s in FROZEN_RISE_M},
        **{s: _is_still(s, limit[s]) for s in STILL_RISE_M},
    }


def _step_of_packs(signal: str) -> pl.Expr:
    """Return the step; infinite where every reading of two packs' sensors is one: two do not freeze on one flight."""
    two_sensors = pl.col("_leg").n_unique() > 1 if signal not in SHARED_SENSORS else pl.lit(False)
    return pl.when(two_sensors).then(reading_step(signal).fill_null(inf)).otherwise(reading_step(signal))


def reading_step(signal: str) -> pl.Expr:
    """Return the step of the recorder: the least difference of two readings in a group, of both packs together."""
    return pl.col(signal).unique().sort().diff().filter(pl.col(signal).unique().sort().diff() > 1e-9).min()


def flow_steps(samples: pl.DataFrame) -> pl.DataFrame:
    """Return how coarse a recorder's flows are: `FLIGHT`, `pack_flow_step_ln` and `cc_flow_step_ln`, of snapshots."""
    snapshots = samples.filter(pl.col("source") == "acms")
    signals = {"pack_flow_step_ln": "pack_flow_kg_s", "cc_flow_step_ln": "cc_flow_kg_s"}
    return snapshots.group_by(FLIGHT).agg(_coarse_step_ln(signal).alias(name) for name, signal in signals.items())


def _coarse_step_ln(flow: str) -> pl.Expr:
    """Return the recorder's step over the median of the running packs' flow; 0 where noise exceeds its rounding. [-]

    A coarse step repeats its readings; a few readings that lie far apart show none.
    """
    reading = pl.col(flow).drop_nulls()
    step = reading_step(flow)
    is_coarse = (step > COARSE_FLOW_KG_S) & (2 * reading.n_unique() < reading.len())
    running = reading.filter(reading > RUNNING_KG_S).median()
    return pl.when(is_coarse).then(step / running).fill_null(0.0)


def run_of_chance(step: float, sd: float) -> float:
    """Return the run of equal readings that chance hardly makes, of a reading with noise `sd` in steps of `step`.

    At worst the true value stands in the middle of a step and stays.

    Examples
    --------
    >>> [round(run_of_chance(step, 0.008)) for step in (0.002, 0.015, 0.04)]
    [6, 28, 922]
    """
    same = erf(step / (2.0 * sqrt(2.0) * sd))
    return 1.0 + log(CHANCE_RUN) / log(same) if 0.0 < same < 1.0 else inf if same else 0.0


def _hidden_rise_m(signal: str) -> pl.Expr:
    """Return the climb that a step hides, beyond the noise of a reading. [m]"""
    coarse = (pl.col(signal) - 2.0 * READING_SD[signal]).clip(lower_bound=0.0)
    return (coarse / LEAST_GRADIENT[signal]).fill_null(0.0).alias(signal)


def _null(records: pl.DataFrame, bad: dict[str, pl.Expr], count_name: str) -> pl.DataFrame:
    """Null each signal where its flag is true; count the flags of a row."""
    rows = records.with_columns(flag.fill_null(False).alias(f"_bad_{signal}") for signal, flag in bad.items())
    rows = rows.with_columns(
        *(pl.when(~pl.col(f"_bad_{s}")).then(s) for s in bad),
        pl.sum_horizontal(pl.col(f"_bad_{s}").cast(pl.Int32) for s in bad).alias(count_name),
    )
    return rows.drop(f"_bad_{s}" for s in bad)


def _is_out_of_range(signal: str) -> pl.Expr:
    low, high, _ = LIMITS[signal]
    # recorders write a few counts below zero for a flow or speed of zero
    margin = 0.02 * high if low == 0.0 else 0.0
    return pl.col(signal).is_nan() | ~pl.col(signal).is_between(low - margin, high)


def _is_spike(signal: str) -> pl.Expr:
    """Flag a sample beyond both neighbours, on the same side, by more than the signal can jump."""
    jump = LIMITS[signal][2]
    before = pl.col(signal) - pl.col(signal).forward_fill().shift(1).over("_leg")
    after = pl.col(signal) - pl.col(signal).backward_fill().shift(-1).over("_leg")
    return ((before > jump) & (after > jump)) | ((before < -jump) & (after < -jump))


def _run(signal: str) -> pl.Expr:
    """Return the number of the run of equal readings, with gaps bridged."""
    return pl.struct("_leg", pl.col(signal).forward_fill().over("_leg")).rle_id()


def _is_frozen_noisy(signal: str, run_of_chance: pl.Expr) -> pl.Expr:
    run = _run(signal)
    least = pl.max_horizontal(pl.lit(NOISY_RUN), run_of_chance)
    span_s = seconds_between(pl.col("time_utc").max(), pl.col("time_utc").min()).over(run)
    running = pl.col(signal) > OFF_BELOW * LIMITS[signal][1]
    return (pl.col(signal).count().over(run) >= least) & (span_s >= NOISY_RUN_S) & running


def _is_frozen_in_climb(signal: str, hidden_m: pl.Expr) -> pl.Expr:
    read_at_m = pl.col("altitude_m").filter(pl.col(signal).is_not_null())
    rise_m = (read_at_m.max() - read_at_m.min()).over(_run(signal))
    return (rise_m > FROZEN_RISE_M[signal] + hidden_m) & pl.col(signal).is_not_null()


def _is_still(signal: str, run_of_chance: pl.Expr) -> pl.Expr:
    reading = pl.col(signal)
    read_at_m = pl.col("altitude_m").filter(reading.is_not_null())
    is_one = (reading.min() == reading.max()).over("_leg")
    is_long = reading.count().over("_leg") >= pl.max_horizontal(pl.lit(NOISY_RUN), run_of_chance)
    rise_m = (read_at_m.max() - read_at_m.min()).over("_leg")
    is_between_stops = reading.is_between(AT_STOP, 1.0 - AT_STOP, closed="none")
    return is_one & is_between_stops & is_long & (rise_m > STILL_RISE_M[signal])
