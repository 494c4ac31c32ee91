"""Judge each flight of a fleet against its neighbours, its aircraft and the other aircraft; hold what can't be right.

A judgement is a function of the present record and the clock alone: the order in which files came plays no part, and a
flight is released by the same rules when more of the record makes it right.
"""

from datetime import datetime

import polars as pl

from hdt_core.record.facts import AIRBORNE_MACH
from hdt_core.tables.raw import RecordHeld

CLIMB_M = 1_000.0
"""Rise above its first altitude that only a flight makes; a field's pressure altitude changes by less. [m]"""


def judge_flights(flights: pl.DataFrame, now: datetime) -> pl.DataFrame:
    """Select the flights that are held, each with the first reason that applies.

    Parameters
    ----------
    flights : DataFrame
        Table `raw_flights` of the whole fleet.
    now : datetime
        The machine's clock. UTC.

    Returns
    -------
    DataFrame
        `operator, tail, flight_id, departed_at, landed_at, reason, likely_cause, other_flight_id`.
    """
    alone = flights.with_columns(_reason_alone(now), likely_cause=pl.lit(None, pl.String))
    held = alone.filter(pl.col("reason").is_not_null())
    return RecordHeld.conform(held)


def _reason_alone(now: datetime) -> pl.Expr:
    """Give the reason that a flight's own record shows, null where it shows none."""
    is_after_clock = pl.col("landed_at") > now
    return (
        pl.when(is_after_clock).then(pl.lit("after_clock"))
        .when(~flies()).then(pl.lit("no_flight"))
        .alias("reason")
    )  # fmt: skip


def flies() -> pl.Expr:
    """Return whether a flight leaves the ground, by its Mach number or altitude; true where neither was recorded."""
    fast = pl.col("highest_mach") > AIRBORNE_MACH
    high = pl.col("highest_altitude_m") > pl.col("first_altitude_m") + CLIMB_M
    is_known = pl.col("highest_mach").is_not_null() | pl.col("highest_altitude_m").is_not_null()
    return fast.fill_null(False) | high.fill_null(False) | ~is_known
