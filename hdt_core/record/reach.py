"""Find flights out of reach of their aircraft's other flights and of the fleet's."""

from collections.abc import Mapping
from datetime import timedelta
from typing import Any

import polars as pl

from hdt_core.record.causes import likely_cause
from hdt_core.records.keys import AIRCRAFT, FLIGHT

REACH_DAYS = 10.0
"""Longest pause of an aircraft whose flights are in reach of each other. [days]"""
USUAL_GAPS = 20.0
"""The same as a multiple of the aircraft's median gap, where that is longer: some fly once a week."""
FEW_FLIGHTS = 10
"""Flights, about three days, that are held where no other aircraft flies at their time; more need a likely cause."""
FEW_GAPS = 5
"""Gaps of an aircraft below which the fleet's median stands for its own."""
_GROUP = [*AIRCRAFT, "group"]


def out_of_reach(flights: pl.DataFrame, delivered_on: pl.DataFrame) -> pl.DataFrame:
    """Select the flights that are out of reach of the rest of their aircraft's record and of the fleet's.

    An aircraft's flights form groups with pauses between. The group with most flights is its record; another, or a few
    flights of a new aircraft, is out of reach where no other aircraft flies at its time, and it is small or a likely
    cause shows it to belong elsewhere.

    Parameters
    ----------
    flights : DataFrame
        `FLIGHT`, `departed_at`, `landed_at` of the fleet.
    delivered_on : DataFrame
        `AIRCRAFT`, `delivered_on`: at the time of a group before its aircraft's delivery, others count for nothing.

    Returns
    -------
    DataFrame
        `FLIGHT`, `likely_cause`.
    """
    nothing = flights.select(FLIGHT, likely_cause=pl.lit(None, pl.String)).clear()
    grouped = _with_groups(flights)
    groups = _groups(grouped).join(delivered_on, on=AIRCRAFT, how="left", validate="m:1")
    suspects = groups.filter(~pl.col("is_main") | (pl.col("n") < FEW_FLIGHTS)).sort(_GROUP)
    held_flights = [nothing]
    for suspect in suspects.iter_rows(named=True):
        others = groups.filter((pl.col("operator") != suspect["operator"]) | (pl.col("tail") != suspect["tail"]))
        is_new = suspect["is_main"] and others["n"].sum() < FEW_FLIGHTS  # there is no fleet yet
        is_before_delivery = suspect["delivered_on"] is not None and suspect["end"].date() < suspect["delivered_on"]
        if is_new or (not is_before_delivery and _has_company(suspect, others)):
            continue
        own = grouped.filter(operator=suspect["operator"], tail=suspect["tail"])
        group = own.filter(group=suspect["group"])
        cause = likely_cause(group, own.filter(pl.col("group") != suspect["group"]))
        if cause or suspect["n"] < FEW_FLIGHTS:
            held_flights.append(group.select(FLIGHT, likely_cause=pl.lit(cause, pl.String)))
    return pl.concat(held_flights)


def _with_groups(flights: pl.DataFrame) -> pl.DataFrame:
    """Number each aircraft's groups of flights, in order of departure: `group`."""
    ordered = flights.sort(*AIRCRAFT, "departed_at", "flight_id")
    last_landing = pl.col("landed_at").cum_max().shift().over(AIRCRAFT)
    gap_s = (pl.col("departed_at") - last_landing).dt.total_seconds()
    with_gaps = ordered.with_columns(gap_s.alias("gap_s"))
    has_many = pl.col("gap_s").count().over(AIRCRAFT) >= FEW_GAPS
    own_usual_s = pl.when(has_many).then(pl.col("gap_s").median().over(AIRCRAFT))
    usual_s = pl.coalesce(own_usual_s, pl.col("gap_s").median())
    reach_s = pl.max_horizontal(pl.lit(REACH_DAYS * 86_400), USUAL_GAPS * usual_s)
    is_new = (pl.col("gap_s") > reach_s).fill_null(False)
    return with_gaps.with_columns(is_new.cast(pl.Int64).cum_sum().over(AIRCRAFT).alias("group"))


def _groups(grouped: pl.DataFrame) -> pl.DataFrame:
    """Summarise the groups; the one with most flights, of two the later, is the aircraft's record: `is_main`."""
    start = pl.col("departed_at").min().alias("start")
    groups = grouped.group_by(_GROUP).agg(start, pl.col("landed_at").max().alias("end"), pl.len().alias("n"))
    place = pl.struct("n", "start").rank("ordinal", descending=True).over(AIRCRAFT)
    return groups.with_columns(is_main=place == 1)


def _has_company(suspect: Mapping[str, Any], others: pl.DataFrame) -> bool:
    """Return whether another aircraft's record, or half of the other aircraft, reach to the time of a group."""
    reach = timedelta(days=REACH_DAYS)
    near = others.filter(pl.col("start") <= suspect["end"] + reach, pl.col("end") >= suspect["start"] - reach)
    n_others = others.select(AIRCRAFT).n_unique()
    n_near = near.select(AIRCRAFT).n_unique()
    return bool(near["is_main"].any()) or 2 * n_near >= n_others > 0
