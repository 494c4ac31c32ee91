"""The shift that takes misdated flights back to a hole in their aircraft's record."""

from datetime import UTC, datetime, timedelta

import polars as pl
import pytest

from hdt_core.record.causes import likely_cause
from tests.support.flight_lists import START, flight, listed

LENGTH = timedelta(minutes=90)
HOLE = START + timedelta(days=10)
"""Where the flight belongs that is dated a year on."""


def record(ends: timedelta, begins: timedelta) -> pl.DataFrame:
    """Flights that end so long before the hole's flight departs, and begin so long after it has landed."""
    before = flight("LX-AA1", HOLE - ends - LENGTH, 1)
    after = flight("LX-AA1", HOLE + LENGTH + begins, 3)
    return listed([before, after])


@pytest.fixture
def misdated() -> pl.DataFrame:
    return listed([flight("LX-AA1", HOLE.replace(year=HOLE.year + 1), 2)])


MINUTE = timedelta(minutes=1)


@pytest.mark.parametrize(
    ("ends", "begins", "cause"),
    [
        (timedelta(0), timedelta(0), "year"),
        (-MINUTE, MINUTE, None),
        (MINUTE, -MINUTE, None),
        (timedelta(days=3), timedelta(days=9), "year"),
        (timedelta(days=3, minutes=1), timedelta(days=9), None),
    ],
)
def test_year_fits_hole(misdated, ends, begins, cause):
    """No overlap, and a flight within three days."""
    assert likely_cause(misdated, record(ends, begins)) == cause


def misdate(right: datetime, wrong: datetime) -> str | None:
    """The likely cause of a flight's wrong date: it left a hole of its own length in a long record."""
    long = timedelta(days=200)
    before = flight("LX-AA1", right - long, 1, landed_at=right)
    after = flight("LX-AA1", right + LENGTH, 3, landed_at=right + long)
    return likely_cause(listed([flight("LX-AA1", wrong, 2)]), listed([before, after]))


def moment(year: int, month: int = 3, day: int = 14, hour: int = 6, minute: int = 0) -> datetime:
    return datetime(year, month, day, hour, minute, tzinfo=UTC)


@pytest.mark.parametrize(
    ("right", "wrong", "cause"),
    [
        (moment(2024, 3, 12), moment(2024, 12, 3), "day_month_exchanged"),
        (moment(2024, 12, 3), moment(2024, 3, 12), "day_month_exchanged"),
        (moment(2024), moment(2024, hour=20), "hours"),
        (moment(2024), moment(2024, 3, 13, 16), "hours"),
        (moment(2024), moment(2024, hour=20, minute=30), None),
        (moment(2024), moment(2049), "year"),
        (moment(2049), moment(2024), "year"),
        (moment(2024), moment(2050), None),
        (moment(2199), moment(2200), "year"),
        (moment(2200), moment(2201), None),
        (moment(2024), moment(2024) + timedelta(weeks=1024), "week_rollover"),
        (moment(2024), moment(2024) - timedelta(weeks=1024), "week_rollover"),
        (moment(2024), moment(2024, 4), "month"),
        (moment(2024), moment(2024, 2), "month"),
    ],
)
def test_cause_is_shift_to_hole(right, wrong, cause):
    assert misdate(right, wrong) == cause


@pytest.mark.parametrize("leg", [1, 3])
def test_record_may_begin_or_end_there(misdated, leg):
    neighbours = record(MINUTE, MINUTE)

    assert likely_cause(misdated, neighbours.filter(pl.col("flight_id").str.ends_with(f"{leg:02d}"))) == "year"


@pytest.mark.parametrize(("source", "minutes", "cause"), [("cpl", 30, "year"), ("cpl", 31, None), ("acms", 0, None)])
def test_other_recorder_may_hold_flight(misdated, source, minutes, cause):
    """The same id near the same time, from another recorder, is the same flight."""
    twin = flight("LX-AA1", HOLE + timedelta(minutes=minutes), 2, source=source)
    neighbours = record(timedelta(hours=4), timedelta(hours=4))

    assert likely_cause(misdated, pl.concat([neighbours, listed([twin])])) == cause


def test_every_flight_must_fit_the_hole(misdated):
    """The first of two begins a minute too early."""
    later = flight("LX-AA1", HOLE.replace(year=HOLE.year + 1) + timedelta(hours=5), 3)
    neighbours = record(-MINUTE, timedelta(hours=20))

    assert likely_cause(pl.concat([misdated, listed([later])]), neighbours) is None
