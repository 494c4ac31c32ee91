"""The shift that takes misdated flights back to a hole in their aircraft's record."""

from datetime import timedelta

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
