"""Flights whose printed reports say that the packs were not fed as they are on a normal cruise."""

import polars as pl

from hdt_core.flight.legs import PACK_OFF_FLOW_KG_S
from hdt_core.flight.phases import CRUISE_FLOOR_M, LEG_KEY

BLEED = "BLEED"
"""Reason of such a leg."""
ODD_BLEED = "a printed report of the cruise says that a bleed or a pack was off, or the cross-feed open"
"""What that reason means."""
LONGEST_FLIGHT = "20h"
_FLIGHT = list(LEG_KEY[:3])


def odd_bleed(reports: pl.DataFrame) -> pl.Expr:
    """Whether a report from above 15,000 ft says that a bleed or a pack was off, or the cross-feed open.

    Below, packs are off for take-off and the APU feeds them on the ground: that is normal. What a report does not say
    is taken as normal.
    """
    closed = [~pl.col(c) for c in reports.columns if c.startswith("bleed_")]
    off = [pl.col(c) < PACK_OFF_FLOW_KG_S for c in reports.columns if c.endswith("_flow_kg_s")]
    odd = pl.any_horizontal(*(e.fill_null(False) for e in (*closed, *off, pl.col("crossfeed_open"))))
    return odd & (pl.col("altitude_m") > CRUISE_FLOOR_M).fill_null(False)


def turn_away_odd_bleed(legs: pl.DataFrame, reports: pl.DataFrame) -> pl.DataFrame:
    """Give legs that passed so far the reason `BLEED` where a report of their flight tells of odd bleed.

    Parameters
    ----------
    legs : DataFrame
        `LEG_KEY`, `departed_at`, `reason`; where there, `admitted` and `n_nominal` follow. Of both packs: what one is
        not fed by, the other is.
    reports : DataFrame
        Of table `raw_reports`: `operator`, `tail`, `reported_at`, `altitude_m`, and what was open or flowed.
    """
    odd = reports.filter(odd_bleed(reports)).select("operator", "tail", "reported_at").sort("reported_at")
    if odd.is_empty():
        return legs
    flights = legs.select(*_FLIGHT, "departed_at").unique().sort("departed_at")
    told = odd.join_asof(
        flights, left_on="reported_at", right_on="departed_at", by=["operator", "tail"], tolerance=LONGEST_FLIGHT,
        check_sortedness=False,
    )  # fmt: skip
    hits = told.drop_nulls("flight_id").select(*_FLIGHT, _odd=pl.lit(True)).unique()
    turned = pl.col("_odd").fill_null(False) & (pl.col("reason") == "")
    follows = {"admitted": pl.lit(False), "n_nominal": pl.lit(0, pl.Int64)}
    changed = {"reason": pl.lit(BLEED), **{c: e for c, e in follows.items() if c in legs.columns}}
    joined = legs.join(hits, on=_FLIGHT, how="left", maintain_order="left", validate="m:1")
    return joined.with_columns(pl.when(turned).then(e).otherwise(pl.col(c)).alias(c) for c, e in changed.items()).drop(
        "_odd"
    )
