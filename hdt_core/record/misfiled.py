"""Find single flights whose two packs differ as those of another aircraft, or as their own in each other's place.

What distinguishes two packs (offsets of sensors, ducts, wear, the flow they are set to) is an aircraft's own. A flight
that leaves its aircraft's usual differences, before and after, and has another's, was delivered under a wrong tail. One
that has its own with the opposite sign was recorded with the packs exchanged. A unit, sensor or map that is changed
moves all flights from then on, so the flights after it are like each other.
"""

from typing import Literal

import polars as pl

from hdt_core.record.exchange import BETWEEN_PACKS, EXCHANGED, LEAST_FLIGHTS, MOST_FLIGHTS, flight_to_flight_sd
from hdt_core.records.keys import AIRCRAFT, FLIGHT

MISFILED = "misfiled"
"""Reason of flights that look like another aircraft's."""
LEAST_SIGNALS = 6
"""Fewest signals of `BETWEEN_PACKS` by which a flight is compared."""
MOST_SDS = 4.0
"""Standard deviations beyond which a signal's deviation counts no more: one sensor alone proves nothing."""
LIKE = 3.0
"""Mean square deviation from an aircraft's usual differences below which a flight is like its flights."""
LIKE_NEIGHBOUR = 2.0
"""The same from the flight before or after, with the noise of both; nine in ten flights are within it."""
MARGIN = 2.5
"""How much larger the mean square must be from the flight's own aircraft than from a sole other aircraft."""
MARGIN_A_DOUBLING = 0.5
"""How much more for each doubling of the aircraft it is compared with, which doubles chance matches."""


def misfiled(flights: pl.DataFrame) -> pl.DataFrame:
    """Select the flights unlike their own aircraft's: like another's of the operator, or with the packs exchanged.

    Parameters
    ----------
    flights : DataFrame
        `FLIGHT`, `departed_at` and the columns of `BETWEEN_PACKS`, without flights that are held for other reasons.

    Returns
    -------
    DataFrame
        `FLIGHT`, `reason`, `other_flight_id`: the flight before it, or else after it, of the aircraft that it is like;
        null where the packs were exchanged.
    """
    ordered = _with_scatter(flights.select(*FLIGHT, "departed_at", *BETWEEN_PACKS).sort("departed_at", "flight_id"))
    suspects = _unlike_their_own(ordered)
    exchanged = _exchanged_once(suspects, ordered)
    others = _like_another(suspects.join(exchanged, on=FLIGHT, how="anti"), ordered)
    return pl.concat([exchanged, others], how="diagonal")


def _exchanged_once(suspects: pl.DataFrame, ordered: pl.DataFrame) -> pl.DataFrame:
    """Select the flights that are like their own aircraft's with the packs in each other's place."""
    mirrored = suspects.with_columns(-pl.col(BETWEEN_PACKS.keys()), like="tail")
    compared = _compare(mirrored, ordered).with_columns(from_mirrored=_from_nearer())
    is_like_mirrored = pl.col("from_mirrored") < LIKE
    is_unlike_own = pl.col("from_own") - pl.col("from_mirrored") > MARGIN
    return compared.filter(is_like_mirrored & is_unlike_own).select(*FLIGHT, reason=pl.lit(EXCHANGED))


def _like_another(suspects: pl.DataFrame, ordered: pl.DataFrame) -> pl.DataFrame:
    """Select the flights that are like another aircraft's."""
    aircraft = ordered.select("operator", like="tail").unique(maintain_order=True)
    pairs = suspects.join(aircraft, on="operator", maintain_order="left", validate="m:m")
    pairs = pairs.filter(pl.col("like") != pl.col("tail"))
    others = _compare(pairs, ordered).with_columns(from_other=_from_nearer()).drop_nulls("from_other")
    by_flight = others.sort("from_other", "like").group_by(FLIGHT, maintain_order=True)
    nearest = by_flight.agg(pl.col("from_own", "from_other", "other_flight_id").first(), n_others=pl.len())
    margin = MARGIN + MARGIN_A_DOUBLING * pl.col("n_others").log(2.0)
    is_like_other = pl.col("from_other") < LIKE
    is_unlike_own = pl.col("from_own") - pl.col("from_other") > margin
    return nearest.filter(is_like_other & is_unlike_own).select(*FLIGHT, "other_flight_id", reason=pl.lit(MISFILED))


def _with_scatter(ordered: pl.DataFrame) -> pl.DataFrame:
    """Add each difference's standard deviation from flight to flight: the aircraft's, or its operator's where larger.

    A flight is compared with all aircraft by the same one, or much would be like an aircraft whose flights scatter.
    """
    sds = {name: (flight_to_flight_sd(name), flight_to_flight_sd(name, ["operator"])) for name in BETWEEN_PACKS}
    return ordered.with_columns(pl.max_horizontal(both).alias(f"{name}_sd") for name, both in sds.items())


def _unlike_their_own(ordered: pl.DataFrame) -> pl.DataFrame:
    """Select flights unlike what is usual for their aircraft, before and after them, and unlike both flights beside."""
    compared = _compare(ordered.with_columns(like="tail"), ordered)
    is_known = pl.col("from_earlier").is_not_null() & pl.col("from_later").is_not_null()
    is_unlike = is_known & (_from_nearer() > MARGIN) & (pl.col("from_neighbour") > LIKE_NEIGHBOUR)
    return compared.filter(is_unlike).select(ordered.columns, from_own=_from_nearer())


def _from_nearer() -> pl.Expr:
    """Return how far a flight is from the nearer of an aircraft's usual differences."""
    return pl.min_horizontal("from_earlier", "from_later")


def _compare(pairs: pl.DataFrame, ordered: pl.DataFrame) -> pl.DataFrame:
    """Compare each flight with those of the aircraft `like` before and after it.

    Adds the mean squares from their medians, `from_earlier` and `from_later`, and from the more alike of the two
    flights beside it, `from_neighbour`; and one of these two, `other_flight_id`.
    """
    values = pl.col(BETWEEN_PACKS.keys())
    earlier = values.rolling_median(MOST_FLIGHTS, min_samples=LEAST_FLIGHTS)
    later = values.reverse().rolling_median(MOST_FLIGHTS, min_samples=LEAST_FLIGHTS).reverse()
    last = _meet(pairs, ordered, earlier, "backward")
    following = _meet(pairs, ordered, later, "forward")
    return pairs.with_columns(
        from_earlier=last["from_usual"],
        from_later=following["from_usual"],
        from_neighbour=pl.min_horizontal(last["from_neighbour"], following["from_neighbour"]),
        other_flight_id=pl.coalesce(last["neighbour"], following["neighbour"]),
    )


def _meet(
    pairs: pl.DataFrame, ordered: pl.DataFrame, usual: pl.Expr, direction: Literal["backward", "forward"]
) -> pl.DataFrame:
    """Return how far each flight is from the next one of the aircraft `like`, and from what is usual on that side."""
    neighbours = ordered.select(
        "operator",
        "departed_at",
        pl.col("tail").alias("like"),
        pl.col("flight_id").alias("neighbour"),
        pl.col(BETWEEN_PACKS.keys()).name.suffix("_neighbour"),
        usual.over(AIRCRAFT).name.suffix("_usual"),
    )
    met = pairs.join_asof(
        neighbours,
        on="departed_at",
        by=["operator", "like"],
        strategy=direction,
        allow_exact_matches=False,
        check_sortedness=False,  # both are sorted
    )
    from_neighbour = _mean_square("_neighbour") / 2.0  # two flights' noise
    return met.select("neighbour", from_usual=_mean_square("_usual"), from_neighbour=from_neighbour)


def _mean_square(end: str) -> pl.Expr:
    """Return the mean square deviation of a flight from the columns with an end; null where few signals are there."""
    squares = []
    for name in BETWEEN_PACKS:
        sd = pl.when(pl.col(f"{name}_sd") > 0.0).then(f"{name}_sd")
        deviation = (pl.col(name) - pl.col(f"{name}{end}")) / sd
        squares.append(deviation.clip(-MOST_SDS, MOST_SDS) ** 2)
    n_there = pl.sum_horizontal(square.is_not_null() for square in squares)
    return pl.when(n_there >= LEAST_SIGNALS).then(pl.mean_horizontal(squares))
