"""Which flights are held: by their own record, their neighbours, their aircraft and the fleet."""

from datetime import timedelta

import polars as pl
import pytest

from hdt_core.record.judge import judge_flights
from tests.support.flight_lists import NOW, START, fleet, flight, listed


@pytest.fixture(scope="module")
def good() -> pl.DataFrame:
    return fleet()


def judge(*parts: pl.DataFrame) -> dict[str, str]:
    """Reason of each held flight."""
    held = judge_flights(pl.concat(parts), NOW)
    return dict(held.select("flight_id", "reason").iter_rows())


def test_good_flights_are_not_held(good):
    assert judge(good) == {}


@pytest.mark.parametrize(
    ("facts", "reason"),
    [
        ({"highest_mach": 0.0, "highest_altitude_m": 900.0}, "no_flight"),
        ({"highest_mach": None, "highest_altitude_m": 900.0}, "no_flight"),
        ({"highest_mach": 0.0}, None),
        ({"highest_mach": None, "highest_altitude_m": None, "first_altitude_m": None}, None),
    ],
)
def test_what_never_leaves_the_ground_is_held(good, facts, reason):
    run = flight("LX-AA0", START + timedelta(days=3, hours=14), 4, **facts)

    assert judge(good, listed([run])).get(run["flight_id"]) == reason


@pytest.mark.parametrize(("minutes", "reason"), [(-1, None), (1, "after_clock")])
def test_what_lands_after_the_clock_waits(good, minutes, reason):
    landed_at = NOW + timedelta(minutes=minutes)
    own = flight("LX-AA9", landed_at - timedelta(hours=1), 1, landed_at=landed_at)

    assert judge(good, listed([own])).get(own["flight_id"]) == reason
