"""Flights with an abnormal bleed supply of the packs in cruise, by their printed reports."""

import polars as pl

from hdt_core.flight.legs import RUNNING_KG_S
from hdt_core.flight.phases import CRUISE_FLOOR_M
from hdt_core.records.keys import AIRCRAFT, FLIGHT, is_among

BLEED = "BLEED"
"""Reason code of such a leg."""
ODD_BLEED = "a printed report of the cruise says that a bleed or a pack was off, or the cross-feed open"
"""Meaning of `BLEED`."""
LONGEST_FLIGHT = "20h"


def odd_bleed(reports: pl.DataFrame) -> pl.Expr:
    """Whether a report from above 15,000 ft shows a bleed or a pack off, or the cross-feed open.

    Below, packs are off for take-off and the APU feeds them on the ground. Missing values count as normal.
    """
    bleed_off = [~pl.col(c) for c in reports.columns if c.startswith("bleed_")]
    pack_off = [pl.col(c) < RUNNING_KG_S for c in reports.columns if c.endswith("_flow_kg_s")]
    odd = pl.any_horizontal(*(e.fill_null(False) for e in (*bleed_off, *pack_off, pl.col("crossfeed_open"))))
    return odd & (pl.col("altitude_m") > CRUISE_FLOOR_M).fill_null(False)


def reject_odd_bleed(legs: pl.DataFrame, reports: pl.DataFrame) -> pl.DataFrame:
    """Reject legs with reason `BLEED` where a report of their flight shows abnormal bleed.

    Parameters
    ----------
    legs : DataFrame
        `LEG`, `departed_at`, `reason`; `admitted` and `n_nominal` follow where present. Both packs of a flight
        are rejected: where one lacks air the other carries its load.
    reports : DataFrame
        Of table `raw_reports`: `operator`, `tail`, `reported_at`, `altitude_m`, bleed and cross-feed valves, pack
        flows.
    """
    odd = reports.filter(odd_bleed(reports)).select(*AIRCRAFT, "reported_at").sort("reported_at")
    if odd.is_empty():
        return legs
    flights = legs.select(*FLIGHT, "departed_at").unique().sort("departed_at")
    odd_flights = odd.join_asof(
        flights, left_on="reported_at", right_on="departed_at", by=AIRCRAFT, tolerance=LONGEST_FLIGHT,
        check_sortedness=False,
    ).drop_nulls("flight_id").select(FLIGHT).unique()  # fmt: skip
    values = {"reason": pl.lit(BLEED), "admitted": pl.lit(False), "n_nominal": pl.lit(0, pl.Int64)}
    return legs.with_columns(
        pl.when(is_among(odd_flights) & (pl.col("reason") == "")).then(value).otherwise(pl.col(c)).alias(c)
        for c, value in values.items()
        if c in legs.columns
    )
