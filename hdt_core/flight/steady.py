"""Steady state: logs averaged over whole minutes, snapshots that agree with a neighbour, and the test of a drift."""

from collections.abc import Sequence

import polars as pl

from hdt_core.flight.phases import interval_s, number_legs, seconds_between
from hdt_core.flight.quality import SIGNALS

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
