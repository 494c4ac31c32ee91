"""Phases of a flight, at 1/8 to 1 Hz or at snapshot rate."""

from collections.abc import Sequence

import polars as pl

LEVEL_RATE_M_S = 1.524  # 300 ft/min, the usual bound of level flight
LEVEL_BAND_M = 30.48  # 100 ft: RVSM holds a flight level within 65 ft, encoders add a little
CRUISE_FLOOR_M = 4572.0  # 15,000 ft: holds and vectoring below it are no cruise
CRUISE_SHARE = 0.6  # of the leg's highest altitude; steps between cruise levels stay above it
CRUISE_MIN_S = 300.0  # a shorter level run is a level-off
CONTINUOUS_GAP_S = 10.0  # records further apart are snapshots
HALF_WINDOW_S = 30  # 60 s windows, as openap's FlightPhase takes
GROUND_MACH = 0.15


def number_legs(records: pl.DataFrame, by: Sequence[str]) -> pl.DataFrame:
    """Add `_leg`, a number for each group of sorted rows: windows over one integer are several times cheaper."""
    return records.with_columns(pl.struct(by).rle_id().alias("_leg"))


def add_phases(records: pl.DataFrame, *, by: Sequence[str]) -> pl.DataFrame:
    """Add the flight phase and the climb rate behind it.

    Parameters
    ----------
    records : DataFrame
        `by`, `time_utc`, `altitude_m` [m, pressure altitude] and, where recorded, `mach` [-]. A group of `by` holds
        either a continuous log (1 Hz) or snapshots (2 to 10 min); both kinds may be in one frame.

    Returns
    -------
    DataFrame
        The rows of `records`, sorted by `by` and time, with `phase` (`ground`, `climb`, `cruise`, `descent`), `level`
        (bool: holds its altitude) and `climb_rate_m_s` [m/s]. `phase` is null in a leg without altitude.

    Notes
    -----
    A state machine over level runs. A sample is level where the altitude moves by less than 300 ft/min: over 60 s in
    a log, towards a neighbour (and by less than 100 ft) in snapshots. A level run of five minutes or more above
    15,000 ft and above six tenths of the leg's highest altitude is cruise. The rest is climb or descent by the sign
    of its rate; a short level-off belongs to the climb before the highest point and to the descent after it. A flight
    that manoeuvres throughout has no cruise.

    References
    ----------
    .. [1] J. Sun, J. Ellerbroek, J. Hoekstra, Flight extraction and phase identification for large ADS-B datasets, J.
       Aerospace Information Systems 14(10), 2017 (level rate, windows).
    """
    rows = records if "mach" in records.columns else records.with_columns(mach=pl.lit(None, pl.Float64))
    rows = (
        number_legs(rows.sort(*by, "time_utc"), by)
        .with_columns(
            pl.col("altitude_m")
            .interpolate_by("time_utc")
            .forward_fill()
            .backward_fill()
            .over("_leg")
            .alias("_held_m"),
            interval_s().over("_leg").alias("_interval_s"),
        )
        .with_columns((pl.col("_interval_s") <= CONTINUOUS_GAP_S).fill_null(False).alias("_log"))
    )
    logs = rows.filter("_log").with_columns(pl.col("_interval_s").round()).partition_by("_interval_s")
    rates = pl.concat([*map(_rate_log, logs), _rate_snapshots(rows.filter(~pl.col("_log")))])
    phases = _name_phase(_measure_runs(rates.sort("_leg", "time_utc")))
    return phases.select(*records.columns, "phase", "level", "climb_rate_m_s")


def seconds_between(later: pl.Expr, earlier: pl.Expr) -> pl.Expr:
    """Return the time between two instants. [s]"""
    return (later - earlier).dt.total_microseconds() / 1e6


def interval_s() -> pl.Expr:
    """Return the usual time from one row to the next, 1 s at least; null for a single row. [s]"""
    return seconds_between(pl.col("time_utc"), pl.col("time_utc").shift(1)).median().clip(lower_bound=1.0)


def _rate_log(rows: pl.DataFrame) -> pl.DataFrame:
    """Add the climb rate over the 60 s around each reading, truncated at both ends; all logs have one interval."""
    half_window = round(HALF_WINDOW_S / rows["_interval_s"][0])

    def end(column: str, step: int) -> pl.Expr:
        edge = pl.col(column).first() if step > 0 else pl.col(column).last()
        return pl.coalesce(pl.col(column).shift(step).over("_leg"), edge.over("_leg"))

    rise = end("_held_m", -half_window) - end("_held_m", half_window)
    span = seconds_between(end("time_utc", -half_window), end("time_utc", half_window))
    rates = rows.with_columns((rise / span).alias("climb_rate_m_s"))
    return rates.with_columns((pl.col("climb_rate_m_s").abs() < LEVEL_RATE_M_S).fill_null(False).alias("level"))


def _rate_snapshots(rows: pl.DataFrame) -> pl.DataFrame:
    """Add the climb rate towards both neighbours; level where one of them is at the same altitude."""
    rise = pl.col("_held_m").diff()
    span = seconds_between(pl.col("time_utc"), pl.col("time_utc").shift(1))
    level = (rise.abs() < LEVEL_BAND_M) & ((rise / span).abs() < LEVEL_RATE_M_S)
    before = rows.with_columns(
        (rise / span).over("_leg").alias("_before"), level.over("_leg").fill_null(False).alias("_held")
    )
    return before.with_columns(
        pl.mean_horizontal("_before", pl.col("_before").shift(-1).over("_leg")).alias("climb_rate_m_s"),
        (pl.col("_held") | pl.col("_held").shift(-1).over("_leg").fill_null(False)).alias("level"),
    ).drop("_before", "_held")


def _measure_runs(rows: pl.DataFrame) -> pl.DataFrame:
    """Number the runs of level and not level flight; add their length, and the leg's highest altitude and its time."""
    runs = rows.with_columns(pl.col("level").rle_id().over("_leg").alias("_run"))
    run_s = seconds_between(pl.col("time_utc").max(), pl.col("time_utc").min())
    return runs.with_columns(
        run_s.over("_leg", "_run").alias("_run_s"),
        (pl.col("_run") == 0).alias("_opens"),
        (pl.col("_run") == pl.col("_run").max().over("_leg")).alias("_closes"),
        pl.col("_held_m").max().over("_leg").alias("_top_m"),
        pl.col("time_utc").get(pl.col("_held_m").arg_max()).over("_leg").alias("_top_at"),
    )


def _name_phase(rows: pl.DataFrame) -> pl.DataFrame:
    high = (pl.col("_held_m") > CRUISE_FLOOR_M) & (pl.col("_held_m") > CRUISE_SHARE * pl.col("_top_m"))
    low = pl.col("_held_m") < CRUISE_SHARE * pl.col("_top_m")
    # without Mach a level run that opens or closes the recording, far below the top, is the stand or the runway
    is_parked = pl.col("mach").is_null() & pl.col("level") & (pl.col("_opens") | pl.col("_closes")) & low
    rising = pl.when("level").then(pl.col("time_utc") <= pl.col("_top_at")).otherwise(pl.col("climb_rate_m_s") > 0.0)
    phase = (
        pl.when(pl.col("_held_m").is_null()).then(None)
        .when((pl.col("mach") < GROUND_MACH) | is_parked).then(pl.lit("ground"))
        .when(pl.col("level") & high & (pl.col("_run_s") >= CRUISE_MIN_S)).then(pl.lit("cruise"))
        .when(rising).then(pl.lit("climb"))
        .otherwise(pl.lit("descent"))
    )  # fmt: skip
    return rows.with_columns(phase.alias("phase"))
