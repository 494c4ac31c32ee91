"""Flights of an aircraft that overlap: which of them is held."""

from datetime import timedelta

import polars as pl

from hdt_core.record.overlap import overlapping
from tests.support.flight_lists import START, flight, listed


def fly(*flights: tuple[float, int], **facts: object) -> pl.DataFrame:
    """Flights of an hour and a half: hours after the start at which they depart, and leg."""
    rows = (flight("LX-AA0", START + timedelta(hours=h), leg, 100 * k, **facts) for k, (h, leg) in enumerate(flights))
    return listed(list(rows))


def held_legs(flights: pl.DataFrame) -> list[tuple[int, str]]:
    """Leg and reason of each flight that is held."""
    rows = overlapping(flights).select(pl.col("flight_id").str.tail(2).cast(pl.Int64), "reason")
    return sorted(rows.rows())


def test_flight_may_depart_at_landing():
    assert held_legs(fly((0, 1), (1.5, 4), (4, 2), (8, 3))) == []


def test_flight_between_two_is_held_alone():
    """It overlaps both, and their legs follow each other."""
    assert held_legs(fly((0, 1), (1, 4), (2, 2), (8, 3))) == [(4, "overlaps_flight")]


def test_three_copies_leave_one():
    copies = fly((0, 1), (0, 2), (0, 3), mean_altitude_m=8_000.0, mean_tat_k=250.0, mean_hx_in_k=380.0)

    assert held_legs(copies) == [(2, "copy_of_flight"), (3, "copy_of_flight")]


def test_overlap_of_unknown_order_holds_none():
    """Each of two flights is one place off."""
    assert held_legs(fly((0, 2), (1, 1))) == []


def test_other_aircraft_fly_at_the_same_time():
    own = fly((0, 1), (8, 2))

    assert held_legs(pl.concat([own, own.with_columns(operator=pl.lit("BZR"))])) == []
