"""Find flights of an aircraft that overlap: copies of another flight, and those that contradict their neighbours."""

from datetime import timedelta

import polars as pl

from hdt_core.records.keys import AIRCRAFT, FLIGHT

COPY = "copy_of_flight"
"""Reason of flights that were delivered twice."""
SAME_MEANS = {"mean_altitude_m": 50.0, "mean_tat_k": 0.3, "mean_hx_in_k": 0.5}
"""Differences of a flight's means that a decoding with a decimal less makes at most."""
TOGETHER = timedelta(minutes=2)
"""Difference of the begins or ends of one leg in two decodings."""
MAX_ROUNDS = 20
"""Flights that overlap one another, at most."""


def overlapping(flights: pl.DataFrame) -> pl.DataFrame:
    """Select flights that overlap another of their aircraft and can't be right.

    Of two with the same contents, or the same begin or end, the one with fewer values is a copy. Of two others the one
    is held whose place in time contradicts its place by day and leg more. Where nothing tells them apart, neither is
    held: which of them has a wrong end is not known, and changes no order.

    Parameters
    ----------
    flights : DataFrame
        `raw_flights` of the fleet, without flights that are held for other reasons.

    Returns
    -------
    DataFrame
        `FLIGHT`, `reason`, `other_flight_id`.
    """
    held_flights = [flights.select(FLIGHT, reason=pl.lit(None, pl.String), other_flight_id="flight_id").clear()]
    rest = flights
    for _ in range(MAX_ROUNDS):
        verdict = _first_overlaps(rest)
        if verdict.is_empty():
            break
        held_flights.append(verdict)
        rest = rest.join(verdict, on=FLIGHT, how="anti")
    return pl.concat(held_flights)


def _first_overlaps(flights: pl.DataFrame) -> pl.DataFrame:
    """Decide on each overlapping pair that no other pair precedes."""
    ordered = flights.sort(*AIRCRAFT, "departed_at", "flight_id")
    by_day_and_leg = pl.col("flight_id").str.tail(11).rank("ordinal").over(AIRCRAFT).cast(pl.Int64)
    by_time = pl.int_range(pl.len()).over(AIRCRAFT) + 1
    overlaps = (pl.col("departed_at") < pl.col("landed_at").shift()).fill_null(False).over(AIRCRAFT)
    own = ordered.with_columns(
        displaced=(by_day_and_leg - by_time).abs(),
        overlaps=overlaps,
    )
    columns = [c for c in own.columns if c not in AIRCRAFT]
    pairs = own.with_columns(pl.col(columns).shift().over(AIRCRAFT).name.suffix("_first"))
    pairs = pairs.filter("overlaps", ~pl.col("overlaps_first"))
    verdicts = pairs.with_columns(is_same=_is_same(), hold=_to_hold()).with_columns(
        hold=pl.when("is_same").then(_lesser()).otherwise("hold")
    )
    reason = pl.when("is_same").then(pl.lit(COPY)).otherwise(pl.lit("overlaps_flight")).alias("reason")
    second = verdicts.filter(pl.col("hold") == "second").select(*FLIGHT, reason, other_flight_id="flight_id_first")
    first = (
        verdicts.filter(pl.col("hold") == "first")
        .select(*AIRCRAFT, reason, flight_id="flight_id_first", other_flight_id="flight_id")
        .select(second.columns)
    )
    return pl.concat([first, second])


def _is_same() -> pl.Expr:
    """Return whether a pair has the same contents, or begins or ends together: one may be a part of the other."""
    same = [((pl.col(c) - pl.col(f"{c}_first")).abs() <= tolerance) for c, tolerance in SAME_MEANS.items()]
    together = [(pl.col(c) - pl.col(f"{c}_first")).abs() <= TOGETHER for c in ("departed_at", "landed_at")]
    return pl.all_horizontal(e.fill_null(False) for e in same) | pl.any_horizontal(together)


def _lesser() -> pl.Expr:
    """Name the flight of a pair with fewer values; of equal ones that with the later day and leg."""
    n = pl.col("n_values")
    n_first = pl.col("n_values_first")
    first_is_later = pl.col("flight_id_first") > pl.col("flight_id")
    is_first = (n_first < n) | ((n_first == n) & first_is_later)
    return pl.when(is_first.fill_null(False)).then(pl.lit("first")).otherwise(pl.lit("second"))


def _to_hold() -> pl.Expr:
    """Name the flight of a pair that contradicts its neighbours: first or second; null where neither does."""
    displaced = pl.col("displaced")
    displaced_first = pl.col("displaced_first")
    return (
        pl.when(displaced > displaced_first).then(pl.lit("second"))
        .when(displaced_first > displaced).then(pl.lit("first"))
    )  # fmt: skip
