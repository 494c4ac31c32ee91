"""Judge each flight of a fleet against its neighbours, its aircraft and the other aircraft; hold what can't be right.

A judgement is a function of the present record and the clock alone: the order in which files came plays no part, and a
flight is released by the same rules when more of the record makes it right.
"""

from datetime import datetime

import polars as pl

from hdt_core.flight.phases import CRUISE_FLOOR_M
from hdt_core.record.exchange import EXCHANGED, exchanged_packs
from hdt_core.record.facts import AIRBORNE_MACH, SILENCE_S
from hdt_core.record.flow_unit import in_other_unit
from hdt_core.record.misfiled import misfiled
from hdt_core.record.overlap import overlapping
from hdt_core.record.reach import out_of_reach
from hdt_core.record.two_aircraft import of_two_aircraft
from hdt_core.record.two_operators import of_two_operators
from hdt_core.records.keys import AIRCRAFT, FLIGHT
from hdt_core.tables.raw import RecordHeld

CLIMB_M = 1_000.0
"""Rise above its first altitude that only a flight makes; a field's pressure altitude changes by less. [m]"""
CLOCK_BACK_S = 60
"""Step back of the clock in a flight from which on its times are wrong; rounding makes smaller ones. [s]"""
DAY_S = 86_400
"""Step back of a clock whose date was not advanced at midnight, but for the time between two reports. [s]"""
FEW_STEPS = 3
"""Steps back in a file's order up to which a clock was set; a file in no order has more."""
CONTRADICTED = "log_contradicts"
"""Reason of flights that are used without their log."""
CONTINUES_S = 1_800
"""Longest pause in the air between two parts of a flight: three times the longest wait for a report. [s]"""
CLIMB_RATE_M_S = 25.0
"""Fastest change of altitude between the two parts. [m/s]"""


def judge_flights(flights: pl.DataFrame, delivered_on: pl.DataFrame, now: datetime) -> pl.DataFrame:
    """Select the flights that are held, each with the first reason that applies.

    Parameters
    ----------
    flights : DataFrame
        Table `raw_flights` of the whole fleet.
    delivered_on : DataFrame
        `operator, tail, delivered_on` of the fleet list's lines; null where it gives none.
    now : datetime
        The machine's clock. UTC.

    Returns
    -------
    DataFrame
        Rows of `record_held` without file and arrival.
    """
    held_flights = [_alone(flights, now)]
    rest = flights.join(held_flights[0], on=FLIGHT, how="anti")
    for judge in (
        lambda own: of_two_operators(own, delivered_on),
        _continuations,
        overlapping,
        lambda own: _out_of_reach(own, delivered_on),
        in_other_unit,
        of_two_aircraft,
        exchanged_packs,
        misfiled,
        _contradicted,
    ):
        verdict = judge(rest)
        held_flights.append(verdict)
        rest = rest.join(verdict, on=FLIGHT, how="anti")
    verdicts = pl.concat(held_flights, how="diagonal")
    without_log = pl.col("log_fault").is_not_null().alias("without_log")
    of_flights = flights.select(*FLIGHT, "departed_at", "landed_at", without_log)
    rows = of_flights.join(verdicts, on=FLIGHT, validate="1:1")
    return RecordHeld.conform(rows.with_columns(is_used=pl.col("reason").is_in([EXCHANGED, CONTRADICTED])))


def _alone(flights: pl.DataFrame, now: datetime) -> pl.DataFrame:
    """Select flights that their own record shows to be none, or to have a wrong time."""
    set_back = (pl.col("clock_back_s") > CLOCK_BACK_S) & pl.col("n_steps_back").is_between(1, FEW_STEPS)
    reason = (
        pl.when(pl.col("landed_at") > now).then(pl.lit("after_clock"))
        .when(~flies()).then(pl.lit("no_flight"))
        .when(set_back).then(pl.lit("clock_set_back"))
    )  # fmt: skip
    at_midnight = set_back & pl.col("clock_back_s").is_between(DAY_S - SILENCE_S, DAY_S)
    cause = pl.when(at_midnight & (reason == "clock_set_back")).then(pl.lit("midnight"))
    return flights.select(*FLIGHT, reason.alias("reason"), cause.alias("likely_cause")).drop_nulls("reason")


def flies() -> pl.Expr:
    """Return whether a flight leaves the ground, by its Mach number or altitude; true where neither was recorded."""
    fast = pl.col("highest_mach") > AIRBORNE_MACH
    high = pl.col("highest_altitude_m") > pl.col("first_altitude_m") + CLIMB_M
    is_known = pl.col("highest_mach").is_not_null() | pl.col("highest_altitude_m").is_not_null()
    return fast.fill_null(False) | high.fill_null(False) | ~is_known


def _continuations(flights: pl.DataFrame) -> pl.DataFrame:
    """Select flights that begin in cruise where another of the aircraft ended minutes before."""
    ordered = flights.sort(*AIRCRAFT, "departed_at", "flight_id")
    before = pl.col("flight_id", "landed_at", "last_altitude_m").shift().over(AIRCRAFT).name.suffix("_before")
    pairs = ordered.with_columns(before)
    pause_s = (pl.col("departed_at") - pl.col("landed_at_before")).dt.total_seconds()
    change_m = (pl.col("first_altitude_m") - pl.col("last_altitude_m_before")).abs()
    lowest_m = pl.min_horizontal("first_altitude_m", "last_altitude_m_before")
    continues = pause_s.is_between(0, CONTINUES_S) & (lowest_m > CRUISE_FLOOR_M) & (change_m < CLIMB_RATE_M_S * pause_s)
    verdict = pairs.filter(continues.fill_null(False))
    return verdict.select(*FLIGHT, reason=pl.lit("continuation"), other_flight_id="flight_id_before")


def _out_of_reach(flights: pl.DataFrame, delivered_on: pl.DataFrame) -> pl.DataFrame:
    return out_of_reach(flights, delivered_on).with_columns(reason=pl.lit("out_of_reach"))


def _contradicted(flights: pl.DataFrame) -> pl.DataFrame:
    """Select flights whose log contradicts their snapshots."""
    verdict = flights.filter(pl.col("log_fault").is_not_null())
    return verdict.select(*FLIGHT, reason=pl.lit(CONTRADICTED), likely_cause="log_fault")
