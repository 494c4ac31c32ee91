"""Find flights of a tail that two operators delivered: files given on with an aircraft, or a folder that was copied."""

from datetime import timedelta

import polars as pl

from hdt_core.record.overlap import COPY, SAME_MEANS
from hdt_core.records.keys import AIRCRAFT, FLIGHT

CAUSE = "operator_"
"""What the likely cause begins with, before the operator that delivered the flight too."""
TOGETHER = timedelta(minutes=1)
"""Difference of the begins, and of the ends, of one flight in two operators' files."""


def of_two_operators(flights: pl.DataFrame, listed: pl.DataFrame) -> pl.DataFrame:
    """Select the flights that another operator delivered too, of the operator with fewer flights of the aircraft.

    Two aircraft that share a tail fly at their own times and read otherwise: neither is touched.

    Parameters
    ----------
    flights : DataFrame
        `raw_flights` of the fleet, without flights that are held for other reasons.
    listed : DataFrame
        `AIRCRAFT` of the fleet list's lines, one of which counts more than none where both have as many flights.

    Returns
    -------
    DataFrame
        `FLIGHT`, `reason`, `likely_cause`, `other_flight_id`.
    """
    tail = pl.col("flight_id").str.extract(r"([^.]+)_\d{8}_\d\d$").alias("flown_as")
    shared = flights.with_columns(tail).filter(pl.col("operator").n_unique().over("flown_as") > 1)
    columns = [*FLIGHT, "flown_as", "departed_at", "landed_at", *SAME_MEANS]
    ordered = (
        shared.select(columns).join(_places(flights, listed), on=AIRCRAFT, validate="m:1").sort("departed_at", *FLIGHT)
    )
    operators = shared.select("flown_as", other="operator").unique(maintain_order=True)
    pairs = ordered.join(operators, on="flown_as", maintain_order="left", validate="m:m")
    others = ordered.rename({"operator": "other"})
    met = pairs.filter(pl.col("operator") != pl.col("other")).join_asof(
        others.with_columns(begin="departed_at"),
        left_on="departed_at",
        right_on="begin",
        by=["flown_as", "other"],
        strategy="nearest",
        tolerance=TOGETHER,
        suffix="_other",
        check_sortedness=False,  # both are sorted
    )
    copies = met.filter(_is_same(), pl.col("place") > pl.col("place_other"))
    best = copies.sort("place_other", *FLIGHT).unique(FLIGHT, keep="first", maintain_order=True)
    cause = pl.lit(CAUSE) + pl.col("other")
    return best.select(*FLIGHT, reason=pl.lit(COPY), likely_cause=cause, other_flight_id="flight_id_other")


def _places(flights: pl.DataFrame, listed: pl.DataFrame) -> pl.DataFrame:
    """Number the aircraft by their flights, most first."""
    is_listed = listed.select(AIRCRAFT).unique().with_columns(is_listed=pl.lit(True))
    counts = flights.group_by(AIRCRAFT).len("n").join(is_listed, on=AIRCRAFT, how="left", validate="1:1")
    by_flights = counts.sort(
        "n", pl.col("is_listed").fill_null(False), *AIRCRAFT, descending=[True, True, False, False]
    )
    return by_flights.with_row_index("place").select(*AIRCRAFT, "place")


def _is_same() -> pl.Expr:
    """Return whether a pair begins and ends together and has the same contents; what neither recorded is the same."""
    both_ends = [(pl.col(c) - pl.col(f"{c}_other")).abs() <= TOGETHER for c in ("departed_at", "landed_at")]
    same = [((pl.col(c) - pl.col(f"{c}_other")).abs() <= tolerance) for c, tolerance in SAME_MEANS.items()]
    neither = [pl.col(c).is_null() & pl.col(f"{c}_other").is_null() for c in SAME_MEANS]
    contents = [one.fill_null(False) | none for one, none in zip(same, neither, strict=True)]
    is_known = ~pl.all_horizontal(neither)
    return pl.all_horizontal(*both_ends, *contents, is_known).fill_null(False)
