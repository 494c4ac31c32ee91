"""Flights with an abnormal bleed supply of the packs in cruise, by their printed reports."""

import polars as pl

from hdt_core.flight.legs import PACK_OFF_FLOW_KG_S
from hdt_core.flight.phases import CRUISE_FLOOR_M, LEG_KEY

BLEED = "BLEED"
"""Reason code of such a leg."""
ODD_BLEED = "a printed report of the cruise says that a bleed or a pack was off, or the cross-feed open"
"""Meaning of `BLEED`."""
LONGEST_FLIGHT = "20h"
_FLIGHT = list(LEG_KEY[:3])


def odd_bleed(reports: pl.DataFrame) -> pl.Expr:
    """Whether a report from above 15,000 ft shows a bleed or a pack off, or the cross-feed open.

    Below, packs are off for take-off and the APU feeds them on the ground. Missing values count as normal.
    """
    bleed_off = [~pl.col(c) for c in reports.columns if c.startswith("bleed_")]
    pack_off = [pl.col(c) < PACK_OFF_FLOW_KG_S for c in reports.columns if c.endswith("_flow_kg_s")]
    odd = pl.any_horizontal(*(e.fill_null(False) for e in (*bleed_off, *pack_off, pl.col("crossfeed_open"))))
    return odd & (pl.col("altitude_m") > CRUISE_FLOOR_M).fill_null(False)


def reject_odd_bleed(legs: pl.DataFrame, reports: pl.DataFrame) -> pl.DataFrame:
    """Reject legs with reason `BLEED` where a report of their flight shows abnormal bleed.

    Parameters
    ----------
    legs : DataFrame
        `LEG_KEY`, `departed_at`, `reason`; `admitted` and `n_nominal` follow where present. Both packs of a flight
        are rejected: where one lacks air the other carries its load.
    reports : DataFrame
        Of table `raw_reports`: `operator`, `tail`, `reported_at`, `altitude_m`, bleed and cross-feed valves, pack
        flows.
    """
    odd = reports.filter(odd_bleed(reports)).select("operator", "tail", "reported_at").sort("reported_at")
    if odd.is_empty():
        return legs
    flights = legs.select(*_FLIGHT, "departed_at").unique().sort("departed_at")
    reported = odd.join_asof(
        flights, left_on="reported_at", right_on="departed_at", by=["operator", "tail"], tolerance=LONGEST_FLIGHT,
        check_sortedness=False,
    )  # fmt: skip
    hits = reported.drop_nulls("flight_id").select(*_FLIGHT, _odd=pl.lit(True)).unique()
    reject = pl.col("_odd").fill_null(False) & (pl.col("reason") == "")
    follows = {"admitted": pl.lit(False), "n_nominal": pl.lit(0, pl.Int64)}
    changed = {"reason": pl.lit(BLEED), **{c: e for c, e in follows.items() if c in legs.columns}}
    flagged = legs.join(hits, on=_FLIGHT, how="left", maintain_order="left", validate="m:1")
    return flagged.with_columns(pl.when(reject).then(e).otherwise(pl.col(c)).alias(c) for c, e in changed.items()).drop(
        "_odd"
    )
