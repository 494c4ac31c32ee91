"""Which flights are out of reach of their aircraft's others and of the fleet's."""

from datetime import UTC, date, datetime, timedelta

import polars as pl
import pytest

from hdt_core.record.reach import out_of_reach

START = datetime(2024, 1, 1, tzinfo=UTC)
HOME = ("AAA", "LX-1")
AWAY = ("BBB", "LX-2")


def fly(aircraft: tuple[str, str], *days: float, hours: float = 2.0) -> pl.DataFrame:
    """A flight on each of these days."""
    operator, tail = aircraft
    rows = [
        {
            "operator": operator,
            "tail": tail,
            "flight_id": f"{operator}_{tail}_{day}",
            "departed_at": START + timedelta(days=day),
            "landed_at": START + timedelta(days=day, hours=hours),
            "source": "acms",
        }
        for day in days
    ]
    return pl.DataFrame(rows)


def find_held_days(*flights: pl.DataFrame, delivered_on: date | None = None) -> list[int]:
    """Days of the flights out of reach."""
    delivery = pl.DataFrame(
        [(*HOME, delivered_on)],
        schema={"operator": pl.String, "tail": pl.String, "delivered_on": pl.Date},
        orient="row",
    )
    rows = out_of_reach(pl.concat(flights), delivery)
    return sorted(int(name.rpartition("_")[2]) for name in rows["flight_id"])


RECORD = fly(HOME, *range(30))


@pytest.mark.parametrize(("day", "days"), [(39, []), (200, [200])])
def test_flights_beyond_pause_are_held(day, days):
    assert find_held_days(RECORD, fly(HOME, day)) == days


def test_late_landing_bridges_pause():
    """A clock that ran on at the end of one flight moves no later flight out of reach."""
    late = fly(HOME, 30, hours=24 * 24)
    assert find_held_days(RECORD, late, fly(HOME, 31, 53)) == []


@pytest.mark.parametrize("first", [70, 140])
@pytest.mark.parametrize(("apart", "days"), [(10.0, []), (10.01, [100])])
def test_company_is_within_ten_days(first, apart, days):
    """Another's record of twenty days that ends so long before the flight, or begins so long after it has landed."""
    flight_ends = 100 + 2 / 24
    begin = flight_ends + apart if first > 100 else 100 - apart - 20 - 2 / 24
    other = fly(AWAY, *(begin + day for day in range(21)))

    assert find_held_days(RECORD, fly(HOME, 100), other) == days


@pytest.mark.parametrize(("n_away", "days"), [(1, [100, 100]), (2, [])])
def test_half_of_fleet_is_company(n_away, days):
    """Of three other aircraft some flew a single flight then, far from their records."""
    tails = [("BBB", f"LX-{k}") for k in (2, 3, 4)]
    records = [fly(tail, *range(30)) for tail in tails]
    flights_then = [fly(tail, 100) for tail in [HOME, *tails[:n_away]]]

    assert find_held_days(RECORD, *records, *flights_then) == days


def test_other_operators_tail_is_company():
    other = fly(("BBB", "LX-1"), *range(95, 110))
    assert find_held_days(RECORD, fly(HOME, 100), other) == []


def test_flights_before_delivery_have_no_company():
    other = fly(AWAY, *range(60))
    early = fly(HOME, 0)
    record = fly(HOME, *range(40, 70))
    assert find_held_days(record, early, other, delivered_on=date(2024, 2, 5)) == [0]


def test_group_about_delivery_has_company():
    other = fly(AWAY, *range(60))
    record = fly(HOME, *range(40, 70))
    assert find_held_days(record, fly(HOME, 0, 3), other, delivered_on=date(2024, 1, 3)) == []


@pytest.mark.parametrize(("pause_days", "days"), [(19.9, []), (20.1, [29])])
def test_weekly_flights_reach_further(pause_days, days):
    """Twenty usual gaps of a day, of 24 hours less the flight."""
    record = fly(HOME, *(d * 1.0 for d in range(8)), hours=0.0)
    late = fly(HOME, 7 + pause_days, hours=0.0).with_columns(flight_id=pl.lit("AAA_LX-1_29"))

    assert find_held_days(record, late) == days


@pytest.mark.parametrize(("n", "days"), [(9, list(range(100, 109))), (10, [])])
def test_ten_flights_need_a_cause(n, days):
    assert find_held_days(fly(HOME, *range(30)), fly(HOME, *range(100, 100 + n))) == days


@pytest.mark.parametrize(("n_others", "days"), [(9, []), (10, [300])])
def test_new_aircraft_needs_a_fleet(n_others, days):
    assert find_held_days(fly(HOME, 300), fly(AWAY, *range(n_others))) == days
