"""Find runs of flights of two aircraft of an operator that were delivered under each other's tail.

What distinguishes an aircraft's two packs (offsets of sensors, ducts, wear, the flow they are set to) goes on from
flight to flight. Where it breaks for two aircraft at one time, and each goes on as the other was, the aircraft changed
places on record: a unit, sensor or map that is changed moves one of them, and not to where the other was.
"""

from datetime import datetime
from typing import Any

import polars as pl

from hdt_core.record.exchange import AFTER, BETWEEN_PACKS, LEAST_FLIGHTS, MOST_FLIGHTS, flight_to_flight_sd
from hdt_core.record.misfiled import LEAST_SIGNALS, MISFILED, MOST_SDS
from hdt_core.records.keys import FLIGHT

CAUSE = "aircraft_"
"""What the likely cause begins with, before the tail under which the aircraft's own flights were delivered."""
LIKE = 1.5
"""Mean square deviation of the flights after a change from those of the other aircraft before it, at most."""
UNLIKE = 2.0
"""How much larger the mean square from their own aircraft must be, for both aircraft."""
UNLIKE_AGAIN = 0.5
"""The same of two aircraft one change of which is known: the other end of the run is sought."""
EVIDENCE = 3.0
"""How much larger the sum of both mean squares must be from their own, and from their own with the packs exchanged."""
MAX_CHANGES = 40
"""Changes of one operator that are followed."""
_SIGNALS = list(BETWEEN_PACKS)
_OWN_FIRST = (("own", "_before"), ("like", "_before_other"))
_OTHER_FIRST = (("own", "_before_other"), ("like", "_before"))


def of_two_aircraft(flights: pl.DataFrame) -> pl.DataFrame:
    """Select the flights of two aircraft that changed places on record.

    Parameters
    ----------
    flights : DataFrame
        `FLIGHT`, `departed_at` and the columns of `BETWEEN_PACKS`, without flights that are held for other reasons.

    Returns
    -------
    DataFrame
        `FLIGHT`, `reason`, `likely_cause`, `other_flight_id`: the flight before it of the aircraft that flew it.
    """
    ordered = _standardise(flights.sort("departed_at", "flight_id"))
    operators = ordered.partition_by("operator", maintain_order=True)
    flown = pl.concat([ordered.with_columns(flown_by="tail").clear(), *map(_name_aircraft, operators)])
    before = pl.col("flight_id").shift().over("operator", "flown_by")
    moved = flown.with_columns(other_flight_id=before).filter(pl.col("flown_by") != pl.col("tail"))
    cause = pl.lit(CAUSE) + pl.col("flown_by")
    return moved.select(*FLIGHT, reason=pl.lit(MISFILED), likely_cause=cause, other_flight_id="other_flight_id")


def _standardise(ordered: pl.DataFrame) -> pl.DataFrame:
    """Divide each difference by its standard deviation from flight to flight: the aircraft's, or its operator's."""
    sds = [pl.max_horizontal(flight_to_flight_sd(name), flight_to_flight_sd(name, ["operator"])) for name in _SIGNALS]
    values = (pl.col(name) / pl.when(sd > 0.0).then(sd) for name, sd in zip(_SIGNALS, sds, strict=True))
    return ordered.select(*FLIGHT, "departed_at", *values)


def _name_aircraft(own: pl.DataFrame) -> pl.DataFrame:
    """Add to each flight of an operator the aircraft that flew it, `flown_by`."""
    flown = own.with_columns(flown_by="tail")
    pairs = _exchanged_pairs(flown)
    if pairs.is_empty():
        return flown
    since = own["departed_at"].min()
    is_likely = (pl.col("evidence") > EVIDENCE) & (pl.col("gain") > UNLIKE_AGAIN)
    for _ in range(MAX_CHANGES):
        later = _crossings(flown, pairs, UNLIKE_AGAIN).filter(is_likely, pl.col("departed_at") > since)
        if later.is_empty():
            break
        change = _clearest_of_first(later)
        since = _begin(change, flown)
        places = {change["flown_by"]: change["other"], change["other"]: change["flown_by"]}
        is_later = pl.col("departed_at") >= since
        flown_by = pl.when(is_later).then(pl.col("flown_by").replace(places)).otherwise("flown_by")
        flown = flown.with_columns(flown_by=flown_by)
    return flown


def _exchanged_pairs(flown: pl.DataFrame) -> pl.DataFrame:
    """Return the aircraft that changed places for certain at least once, each pair in both orders."""
    aircraft = flown.select("flown_by").unique(maintain_order=True)
    all_pairs = aircraft.join(aircraft.select(other="flown_by"), how="cross")
    all_pairs = all_pairs.filter(pl.col("flown_by") != pl.col("other"))
    is_certain = (pl.col("distance") < LIKE) & (pl.col("gain") > UNLIKE) & (pl.col("against_mirrored") > EVIDENCE)
    pairs = _crossings(flown, all_pairs, UNLIKE).filter(is_certain).select("flown_by", "other")
    return pl.concat([pairs, pairs.select(flown_by="other", other="flown_by")]).unique(maintain_order=True)


def _clearest_of_first(crossings: pl.DataFrame) -> dict[str, Any]:
    """Return the clearest of the crossings of the pair that crosses first, among the flights that show it."""
    first = crossings.sort("departed_at", "flown_by", "other").row(0, named=True)
    pair = [first["flown_by"], first["other"]]
    is_near = pl.col("departed_at") <= first["shown_until"]
    near = crossings.filter(is_near, pl.col("flown_by").is_in(pair), pl.col("other").is_in(pair))
    best = near.sort("evidence", "departed_at", "flown_by", descending=[True, False, False])
    return best.row(0, named=True)


def _begin(change: dict[str, Any], flown: pl.DataFrame) -> datetime:
    """Return the departure of the first flight after a change, by each flight beside it."""
    pair = (change["flown_by"], change["other"])
    beside = flown.filter(pl.col("departed_at").is_between(change["shown_since"], change["shown_until"]))
    levels = pl.DataFrame(
        {"flown_by": tail, **{f"{name}_{what}": change[f"{name}{end}"] for what, end in ends for name in _SIGNALS}}
        for tail, ends in zip(pair, (_OWN_FIRST, _OTHER_FIRST), strict=True)
    )
    placed = beside.join(levels, on="flown_by", maintain_order="left", validate="m:1")
    gain = _mean_square("", "_own") - _mean_square("", "_like")
    gain_from_then_on = gain.fill_null(0.0).cum_sum(reverse=True)
    begin: datetime = placed.sort(gain_from_then_on, "departed_at", descending=[True, False])["departed_at"][0]
    return begin


def _breaks(flown: pl.DataFrame) -> pl.DataFrame:
    """Return how the packs typically differ before each flight and from it on, and how far apart these are."""
    values = pl.col(_SIGNALS)
    earlier = values.rolling_median(MOST_FLIGHTS, min_samples=LEAST_FLIGHTS).shift().over("flown_by")
    later = values.reverse().rolling_median(AFTER, min_samples=AFTER).reverse().over("flown_by")
    times = pl.col("departed_at")
    levels = flown.select(
        "flown_by",
        "departed_at",
        times.shift(AFTER).over("flown_by").fill_null(times.min()).alias("shown_since"),
        times.shift(1 - AFTER).over("flown_by").fill_null(times.max()).alias("shown_until"),
        earlier.name.suffix("_before"),
        later.name.suffix("_after"),
    )
    return levels.with_row_index("place").with_columns(from_own=_mean_square("_after", "_before"))


def _crossings(flown: pl.DataFrame, pairs: pl.DataFrame, unlike: float) -> pl.DataFrame:
    """Compare what follows a break of both aircraft of a pair with the other's flights before it.

    Adds the larger mean square from the other, `distance`; how much larger that from their own is, `gain` of the
    lesser and the sum `evidence`; and the same sum from their own with the packs exchanged, `against_mirrored`.
    """
    breaks = _breaks(flown)
    times = breaks.select("place", "flown_by", "departed_at", "from_own")
    suspects = times.filter(pl.col("from_own") > unlike)
    others = times.select(place_other="place", other="flown_by", begin="departed_at", from_own_other="from_own")
    met = suspects.join(pairs, on="flown_by", maintain_order="left", validate="m:m").join_asof(
        others,
        left_on="departed_at",
        right_on="begin",
        by="other",
        strategy="forward",
        check_sortedness=False,  # both are sorted
    )
    both_break = met.filter(pl.col("from_own_other") > unlike).select("place", "place_other")
    levels = breaks.select(pl.exclude("from_own"))
    of_other = breaks.select(pl.exclude("departed_at", "shown_since", "shown_until").name.suffix("_other"))
    compared = (
        both_break.join(levels, on="place", maintain_order="left", validate="m:1")
        .join(of_other, on="place_other", maintain_order="left", validate="m:1")
        .rename({"flown_by_other": "other"})
    )
    from_own = (_mean_square("_after", "_before"), _mean_square("_after_other", "_before_other"))
    from_mirrored = (_mean_square("_after", "_before", -1.0), _mean_square("_after_other", "_before_other", -1.0))
    from_other = (_mean_square("_after", "_before_other"), _mean_square("_after_other", "_before"))
    gains = [own - other for own, other in zip(from_own, from_other, strict=True)]
    return compared.with_columns(
        distance=pl.max_horizontal(from_other),
        gain=pl.min_horizontal(gains),
        evidence=sum(gains),
        against_mirrored=sum(from_mirrored) - sum(from_other),
    )


def _mean_square(end: str, other_end: str, sign: float = 1.0) -> pl.Expr:
    """Return the mean square of two ends of columns' differences; null where few signals are there."""
    squares = [
        (pl.col(f"{name}{end}") - sign * pl.col(f"{name}{other_end}")).clip(-MOST_SDS, MOST_SDS) ** 2
        for name in _SIGNALS
    ]
    n_there = pl.sum_horizontal(square.is_not_null() for square in squares)
    return pl.when(n_there >= LEAST_SIGNALS).then(pl.mean_horizontal(squares))
