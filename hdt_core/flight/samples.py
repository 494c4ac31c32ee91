"""Samples of a flight: phases, screens of single values, and steady state, at 1/8 to 1 Hz or at snapshot rate."""

from collections.abc import Sequence
from math import erf, inf, log, sqrt

import polars as pl

from hdt_core.records.keys import FLIGHT

LEVEL_RATE_M_S = 1.524  # 300 ft/min, the usual bound of level flight
LEVEL_BAND_M = 30.48  # 100 ft: RVSM holds a flight level within 65 ft, encoders add a little
CRUISE_FLOOR_M = 4572.0  # 15,000 ft: holds and vectoring below it are no cruise
CRUISE_SHARE = 0.6  # of the leg's highest altitude; steps between cruise levels stay above it
CRUISE_MIN_S = 300.0  # a shorter level run is a level-off
CONTINUOUS_GAP_S = 10.0  # records further apart are snapshots
RUNNING_KG_S = 0.2  # flow below which a pack is off
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
SHARED_SENSORS = ("tat_k", "total_pressure_pa", "mach")  # both packs may record one and the same
FROZEN_RISE_M = dict.fromkeys(("total_pressure_pa", "cc_in_pa"), 1_000.0)
FROZEN_RISE_M |= dict.fromkeys(("tat_k", "cc_in_k", "hx_in_k", "hx_out_k", "cc_out_k"), 6_000.0)
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
    flags = {s: _is_frozen_noisy(s) for s in NOISY} | {s: _is_frozen_in_climb(s) for s in FROZEN_RISE_M}
    suspects = rows.filter(pl.any_horizontal(flags.values())).select(flight).unique()
    if suspects.is_empty():
        return rows.with_columns(pl.lit(0, pl.Int32).alias("n_frozen"))
    records = rows.join(suspects, on=flight, how="semi")
    steps = records.group_by(flight).agg(_step_of_packs(s).alias(s) for s in flags)
    limits = steps.with_columns(
        *(pl.Series(s, [run_of_chance(step or 0.0, READING_SD[s]) for step in steps[s]]) for s in NOISY),
        *(_hidden_rise_m(s) for s in FROZEN_RISE_M),
    ).rename({s: f"_limit_{s}" for s in flags})
    with_limits = rows.join(limits, on=flight, how="left", maintain_order="left", validate="m:1")
    flags = {s: _is_frozen_noisy(s, pl.col(f"_limit_{s}")) for s in NOISY} | {
        s: _is_frozen_in_climb(s, pl.col(f"_limit_{s}")) for s in FROZEN_RISE_M
    }
    return _null(with_limits, flags, "n_frozen").drop(f"_limit_{s}" for s in flags)


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


def _is_frozen_noisy(signal: str, run_of_chance: pl.Expr | float = 0.0) -> pl.Expr:
    run = _run(signal)
    least = pl.max_horizontal(pl.lit(NOISY_RUN), run_of_chance)
    span_s = seconds_between(pl.col("time_utc").max(), pl.col("time_utc").min()).over(run)
    running = pl.col(signal) > OFF_BELOW * LIMITS[signal][1]
    return (pl.col(signal).count().over(run) >= least) & (span_s >= NOISY_RUN_S) & running


def _is_frozen_in_climb(signal: str, hidden_m: pl.Expr | float = 0.0) -> pl.Expr:
    read_at_m = pl.col("altitude_m").filter(pl.col(signal).is_not_null())
    rise_m = (read_at_m.max() - read_at_m.min()).over(_run(signal))
    return (rise_m > FROZEN_RISE_M[signal] + hidden_m) & pl.col(signal).is_not_null()


WINDOW_S = 60
SLOPE_T_LIMIT = 4.0
MIN_AVERAGED = 45  # seconds of a window that must have been recorded
MIN_SHARE = 0.5  # of a signal's readings in a window that must have a value
# what drives the heat exchanger: largest drift [1/s] that leaves it quasi-steady, and the random sd of a reading
DRIVERS: dict[str, tuple[float, float]] = {
    "altitude_m": (1.524, 5.0),
    "mach": (4.0e-4, 1.5e-3),
    "tat_k": (0.03, 0.35),
    "hx_in_k": (0.08, 0.6),
    "pack_flow_kg_s": (1.5e-3, 0.012),
    "ram_door_open": (2.0e-3, 0.012),
}


def thin_log(records: pl.DataFrame, *, by: Sequence[str]) -> pl.DataFrame:
    """Keep one row a second of continuous logs: the first reading of each signal; other rows stay as they are.

    Rows sorted by `by` and time come back so.
    """
    second = pl.col("time_utc").dt.truncate("1s")
    is_log = pl.col("source") == "cpl"
    twice = records.filter(is_log).select(pl.struct(*by, second).is_duplicated().any()).item()
    if not twice:
        return records
    firsts = [pl.col(c).drop_nulls().first() for c in SIGNALS]
    others = [pl.col(c).first() for c in records.columns if c not in (*by, "time_utc", *SIGNALS)]
    log = records.filter(is_log).group_by(*by, second, maintain_order=True).agg(*others, *firsts)
    return pl.concat([records.filter(~is_log), log.select(records.columns)]).sort(*by, "time_utc", maintain_order=True)


def average_log(log: pl.DataFrame, *, by: Sequence[str], delivered_shares: pl.DataFrame | None = None) -> pl.DataFrame:
    """Average a log over whole minutes of one phase, which serve the twin as precise snapshots.

    Parameters
    ----------
    log : DataFrame
        `by`, `time_utc`, `phase`, `level`, `climb_rate_m_s`, the screen counts and `SIGNALS`, one row in 1 to 10 s;
        `departed_at` of the flight is kept where present.
    delivered_shares : DataFrame, optional
        `by` and, for signals at a lower rate than the log's, the share of rows that hold a reading; null for others.

    Returns
    -------
    DataFrame
        A row a window with the means of the signals, `time_utc` at the window's middle reading, `n_averaged` (seconds
        that the readings stand for) and `steady` (bool): no driver drifts both significantly (slope test, t over 4)
        and faster than `DRIVERS` allows.
    """
    window = (pl.col("time_utc").dt.epoch("s") // WINDOW_S).alias("_window")
    second = pl.col("time_utc").dt.epoch("s").cast(pl.Float64)
    counts = [c for c in log.columns if c.startswith("n_")]
    rows = number_legs(log, by).with_columns(interval_s().over("_leg").fill_null(1.0).alias("_interval_s"))
    shares: dict[str, pl.Expr] = dict.fromkeys(SIGNALS, pl.lit(1.0))
    if delivered_shares is not None:
        slower = [c for c in delivered_shares.columns if c in SIGNALS]
        renamed = delivered_shares.rename({s: f"_share_{s}" for s in slower})
        rows = rows.join(renamed, on=by, how="left", maintain_order="left", validate="m:1")
        shares |= {s: pl.col(f"_share_{s}").first().fill_null(1.0) for s in slower}
    stands_for = (pl.len() * pl.col("_interval_s").first()).clip(upper_bound=float(WINDOW_S))
    windows = rows.group_by(*by, window, "phase", maintain_order=True).agg(
        pl.col("time_utc").median().cast(log.schema["time_utc"]),
        *(pl.col(c).first() for c in ("departed_at",) if c in log.columns),
        pl.col("level").all(),
        pl.col("climb_rate_m_s").mean(),
        *(
            pl.when(pl.col(s).count() > MIN_SHARE * share * pl.len()).then(pl.col(s).mean()).alias(s)
            for s, share in shares.items()
        ),
        *(pl.col(c).sum() for c in counts),
        stands_for.round().cast(pl.Int64).alias("n_averaged"),
        pl.all_horizontal(drift_free(second, s, harmful) for s, (harmful, _) in DRIVERS.items()).alias("steady"),
    )
    return windows.filter(pl.col("n_averaged") >= MIN_AVERAGED).drop("_window")


def drift_free(second: pl.Expr, signal: str, harmful: float) -> pl.Expr:
    """Whether a group's readings show no slope that is both significant and harmful; true where there are none.

    The drift t-test of J. D. Kelly and J. D. Hedengren, J. Process Control 23(3), 2013.

    Parameters
    ----------
    second : Expr
        Time. [s]
    signal : str
        Column of the readings.
    harmful : float
        Largest drift that leaves what the signal drives quasi-steady. [signal's unit / s]
    """
    time = second.filter(pl.col(signal).is_not_null())
    reading = pl.col(signal).drop_nulls()
    slope = pl.cov(time, reading) / time.var()
    degrees = reading.len() - 2
    residual = (reading.var() - slope**2 * time.var()).clip(lower_bound=0.0)
    t = slope.abs() / (residual / (time.var() * degrees)).sqrt()
    return ((t < SLOPE_T_LIMIT) | (slope.abs() < harmful)).fill_null(True)


def steady_snapshots(snapshots: pl.DataFrame, *, by: Sequence[str]) -> pl.DataFrame:
    """Add `steady`: whether a level snapshot agrees with a neighbour in all `DRIVERS`.

    As snapshots allow no slope test, no driver may have changed since the nearer neighbour of the same phase faster
    than `DRIVERS` allows and by more than four times the noise of a difference. Rows sorted by `by` and time.
    """
    steady = pl.col("level") & pl.all_horizontal(_agrees_with_neighbour(s) for s in DRIVERS)
    return number_legs(snapshots, by).with_columns(steady.fill_null(False).alias("steady")).drop("_leg")


def _agrees_with_neighbour(signal: str) -> pl.Expr:
    rate, noise = DRIVERS[signal]

    def excess(step: int) -> pl.Expr:
        change = (pl.col(signal) - pl.col(signal).shift(step).over("_leg")).abs()
        span_s = seconds_between(pl.col("time_utc"), pl.col("time_utc").shift(step).over("_leg")).abs()
        same = pl.col("phase") == pl.col("phase").shift(step).over("_leg")
        return pl.when(same).then(change - pl.max_horizontal(rate * span_s, pl.lit(4.0 * 2**0.5 * noise)))

    return (pl.min_horizontal(excess(1), excess(-1)) <= 0.0).fill_null(True)
