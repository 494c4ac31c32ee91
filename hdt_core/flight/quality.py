"""Screens of single values: physical range, spikes and frozen sensors."""

from collections.abc import Sequence

import polars as pl

from hdt_core.flight.phases import number_legs, seconds_between

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

# noise exceeds resolution: the same reading six times over two minutes is a dead sensor, not a calm flight
NOISY = ("pack_flow_kg_s", "cc_flow_kg_s", "cc_speed_rad_s")
NOISY_RUN, NOISY_RUN_S, OFF_BELOW = 6, 120.0, 0.05
# bound to the air outside: [m] of climb or descent over which a sound sensor can't repeat its reading
FROZEN_RISE_M = {
    "total_pressure_pa": 1_000.0,
    "cc_in_pa": 1_000.0,
    "tat_k": 6_000.0,
    "cc_in_k": 6_000.0,
    "hx_in_k": 6_000.0,
    "hx_out_k": 6_000.0,
    "cc_out_k": 6_000.0,
}


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
    frozen_flags = {s: _is_frozen_noisy(s) for s in NOISY} | {s: _is_frozen_in_climb(s) for s in FROZEN_RISE_M}
    return _null(rows, frozen_flags, "n_frozen").drop("_leg")


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


def _is_frozen_noisy(signal: str) -> pl.Expr:
    run = _run(signal)
    span_s = seconds_between(pl.col("time_utc").max(), pl.col("time_utc").min()).over(run)
    running = pl.col(signal) > OFF_BELOW * LIMITS[signal][1]
    return (pl.col(signal).count().over(run) >= NOISY_RUN) & (span_s >= NOISY_RUN_S) & running


def _is_frozen_in_climb(signal: str) -> pl.Expr:
    read_at_m = pl.col("altitude_m").filter(pl.col(signal).is_not_null())
    rise_m = (read_at_m.max() - read_at_m.min()).over(_run(signal))
    return (rise_m > FROZEN_RISE_M[signal]) & pl.col(signal).is_not_null()
