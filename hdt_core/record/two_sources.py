"""Find continuous logs that contradict the snapshots of their own flight: by their clock, or with the packs exchanged.

A recorder's log and the aircraft's reports come by two ways, each with a clock and a decoding map of its own. Where
they contradict each other the reports alone are used, as on most flights.
"""

from datetime import timedelta

import polars as pl

from hdt_core.record.exchange import BETWEEN_PACKS, are_reversed, between_packs
from hdt_core.records.keys import FLIGHT
from hdt_core.robust import spread_expr

SAME_MOMENT = timedelta(seconds=8)
"""Longest time between a report and the row of the log that it is compared with: the slowest log has one in 8 s."""
APART_M = 300.0
"""Difference of altitude beyond which two rows are of two moments; a climb of 8 s is 150 m. [m]"""
APART_SHARE = 0.2
"""Share of such reports from which the clocks differ: two minutes give half in the sample fleet, a right clock none."""
DISJOINT_S = 1_800
"""Time between the log and the reports from which they are not of one flight. [s]"""
FEWEST = 5
"""Fewest reports by which the packs are compared."""
_LOG = "_log"


def contradicted_logs(rows: pl.DataFrame) -> pl.DataFrame:
    """Select the flights whose log contradicts their snapshots.

    Parameters
    ----------
    rows : DataFrame
        Of `raw_snapshots` and `raw_logs`.

    Returns
    -------
    DataFrame
        `FLIGHT`, `log_fault`: `log_clock` where the two are not of one time, `log_packs` where the packs of one stand
        in each other's place in the other.
    """
    sources = [rows.filter(source=name) for name in ("acms", "cpl")]
    with_both = sources[1].select(FLIGHT).unique().join(sources[0], on=FLIGHT, how="semi")
    if with_both.is_empty():
        return with_both.with_columns(log_fault=pl.lit(None, pl.String))
    reports, log = (_moments(own.join(with_both, on=FLIGHT, how="semi")) for own in sources)
    spans = log.group_by(FLIGHT).agg(begins_at=pl.col("time_utc").min(), ends_at=pl.col("time_utc").max())
    pairs = reports.join(spans, on=FLIGHT, validate="m:1").join_asof(
        log.with_columns(is_paired=True),
        on="time_utc",
        by=FLIGHT,
        strategy="nearest",
        tolerance=SAME_MOMENT,
        suffix=_LOG,
        check_sortedness=False,  # both are sorted
    )
    flights = pairs.group_by(FLIGHT, maintain_order=True).agg(
        _is_of_other_time().alias("is_of_other_time"),
        pl.col("is_paired").sum().alias("n_paired"),
        *(_standardised(name, end) for end in ("", _LOG) for name in BETWEEN_PACKS),
    )
    by_reports, by_log = (flights.select(f"{n}{end}" for n in BETWEEN_PACKS).to_numpy() for end in ("", _LOG))
    is_exchanged = pl.Series(are_reversed(by_reports, by_log)) & (flights["n_paired"] >= FEWEST)
    fault = pl.when("is_of_other_time").then(pl.lit("log_clock")).when(is_exchanged).then(pl.lit("log_packs"))
    return flights.select(*FLIGHT, log_fault=fault).drop_nulls("log_fault")


def without_logs(rows: pl.DataFrame, flights: pl.DataFrame) -> pl.DataFrame:
    """Return recorded rows without the logs of some flights."""
    if flights.is_empty():
        return rows
    of_logs = flights.select(*FLIGHT, source=pl.lit("cpl"))
    return rows.join(of_logs, on=[*FLIGHT, "source"], how="anti", maintain_order="left")


def _moments(rows: pl.DataFrame) -> pl.DataFrame:
    """Summarise the rows of each moment: altitude, and how the packs differ."""
    differences = (between_packs(signal).alias(name) for name, signal in BETWEEN_PACKS.items())
    moments = rows.group_by(*FLIGHT, "time_utc").agg(pl.col("altitude_m").mean(), *differences)
    return moments.sort(*FLIGHT, "time_utc")


def _is_of_other_time() -> pl.Expr:
    """Return whether a flight's reports and its log are of two times, by their altitudes or since neither meets."""
    is_apart = (pl.col("altitude_m") - pl.col(f"altitude_m{_LOG}")).abs() > APART_M
    times = pl.col("time_utc")
    starts = pl.max_horizontal(times.min(), pl.col("begins_at").first())
    ends = pl.min_horizontal(times.max(), pl.col("ends_at").first())
    are_disjoint = (starts - ends).dt.total_seconds() > DISJOINT_S
    return (is_apart.mean() > APART_SHARE).fill_null(False) | are_disjoint


def _standardised(name: str, end: str) -> pl.Expr:
    """Return the median difference of the packs in a flight over the scatter of the reports' own differences."""
    scatter = spread_expr(pl.col(name) - pl.col(name).median())
    paired = pl.col(f"{name}{end}").filter(pl.col("is_paired"))
    return (paired.median() / pl.when(scatter > 0.0).then(scatter)).alias(f"{name}{end}")
