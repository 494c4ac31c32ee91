"""Dates and choices, over fleets made by hand."""

import datetime as dt
import math

import pytest
from answers import rows
from small_catalog import OWN, START, catalog, flight, fouling, replaced

POINTS = {25: 0.1, 50: 0.2, 100: 0.4, 200: 0.7, 300: 0.9}
COSTS = {"wash": 100.0, "replace": 1000.0, "at_check": 50.0, "message": 2000.0}


def flown(per_day: int, days: int, skip: range = range(0)) -> list[dict]:
    """Flights of one tail, so many a day, but for some days."""
    return [
        flight(d) | {"flight_id": f"T-1_2024{d:04d}_{k:02d}", "departed_at": START + dt.timedelta(days=d, hours=2 * k)}
        for d in range(days)
        for k in range(per_day)
        if d not in skip
    ]


def prognosis(n: int, points: dict[int, float] | None = None, **more: object) -> dict:
    chances = {f"p_event_{k}": p for k, p in (points or POINTS).items()}
    return flight(n) | {"pack": 1, "component": "HX"} | chances | {"rul_flights": 120.0, "rul_low": 24.0} | more


def choices(n: int) -> list[dict]:
    """Choices after flight n: each with its own share of the chances of deferring."""
    shares = {"defer": 1.0, "wash": 0.5, "replace": 0.1}
    return [
        prognosis(n, {k: share * p for k, p in POINTS.items()}) | {"choice": choice, "rests_on": "prior"}
        for choice, share in shares.items()
    ]


def stop(check: int | None = None, costs: dict | None = None):
    days = 60
    own = {k: OWN[k] for k in ("operator", "tail")}
    con = catalog(
        raw_flights=flown(3, days),
        twin_health=[fouling(n, 0.2) for n in range(days)],
        prognoses=[prognosis(n) for n in range(days)],
        prognosis_choices=choices(days - 1),
        raw_checks=[
            own | {"planned_on": (START + dt.timedelta(days=days - 1 + n)).date(), "name": f"A{n}"}
            for n in (() if check is None else (-5, check, 999))
        ],
        raw_costs=[
            {"component": "HX", "item": k, "cost": v, "currency": "EUR", "horizon_days": 10}
            for k, v in (COSTS if costs is None else costs).items()
        ],
    )  # fmt: skip
    columns = "choice, check_name, flights, chance, expected_cost, place, status"
    return {r[0]: r[1:] for r in rows(con, f"select {columns} from next_stop")}


@pytest.mark.parametrize("skip", [range(0), range(30, 37), range(10, 14)])
def test_week_without_flights_keeps_rate(skip):
    con = catalog(raw_flights=flown(3, 60, skip))
    ((rate, weeks),) = rows(con, "select flights_per_day, n_weeks from flight_rates")
    assert rate == pytest.approx(3.0, abs=0.2)
    assert weeks == 6


@pytest.mark.parametrize(("days", "weeks", "rate"), [(5, 0, None), (8, 1, 3.0), (22, 3, 3.0)])
def test_short_record_gives_partial_rate(days, weeks, rate):
    con = catalog(raw_flights=flown(3, days))
    assert rows(con, "select n_weeks, flights_per_day from flight_rates") == [(weeks, rate)]


def test_flights_left_become_days():
    con = catalog(raw_flights=flown(3, 60), prognoses=[prognosis(59, rul_high=300.0)])
    dates = rows(con, "select days_left, days_left_low, days_left_high, due_on, status from due_dates")
    assert dates == [(40.0, 8.0, None, (START + dt.timedelta(days=59 + 40)).date(), "ok")]


def test_date_beyond_horizon_has_status():
    con = catalog(raw_flights=flown(3, 60), prognoses=[prognosis(59, rul_flights=300.0, beyond_horizon=True)])
    assert rows(con, "select status from due_dates") == [("beyond_horizon",)]


def test_least_expected_cost_comes_first():
    stops = stop(check=10)
    _, _, chance, cost, _, _ = stops["wash"]
    assert cost == pytest.approx(100 + 2000 * chance)
    assert {choice: row[4] for choice, row in stops.items()} == {"wash": 1, "defer": 2, "replace": 3}


def test_unpriced_choices_have_only_chances():
    stops = stop(check=10, costs={})
    assert {row[3:] for row in stops.values()} == {(None, None, "no_cost")}
    assert stops["replace"][2] < stops["wash"][2] < stops["defer"][2]


@pytest.mark.parametrize(("days", "between"), [(10, (25, 50)), (30, (50, 100)), (50, (100, 200)), (1, (0, 25))])
def test_chance_follows_prognosis_points(days, between):
    name, flights, chance, cost, _, status = stop(check=days)["defer"]
    low = ({0: 0.0} | POINTS)[between[0]]
    high = POINTS[between[1]]
    share = (3 * days - between[0]) / (between[1] - between[0])
    hazard = (1 - share) * math.log(1 - low) + share * math.log(1 - high)
    assert (name, flights, status) == (f"A{days}", 3.0 * days, "ok")
    assert chance == pytest.approx(1 - math.exp(hazard))
    assert cost == pytest.approx(50 + 2000 * chance)


def test_check_beyond_horizon_has_no_chance():
    assert stop(check=101)["defer"] == ("A101", 303.0, None, None, None, "beyond_horizon")


def test_horizon_counts_without_check():
    name, flights, _, _, _, status = stop()["defer"]
    assert (name, flights, status) == (None, 30.0, "no_check_planned")


def test_unit_is_followed_by_serial_number():
    off = replaced(20) | {"serial_off": "S1", "serial_on": "S2"}
    on = replaced(40) | {"tail": "T-2", "serial_off": "S9", "serial_on": "S1"}
    health = [fouling(n, 0.01, tail=t) for t in ("T-1", "T-2") for n in range(60)]
    con = catalog(twin_health=health, raw_maintenance=[off, on])
    lives = rows(con, "select tail, unit, serial, came_from from exchanger_lives order by tail, unit")
    assert lives == [
        ("T-1", 0, "S1", None), ("T-1", 1, "S2", None), ("T-2", 0, "S9", None), ("T-2", 1, "S1", "AAA T-1 1"),
    ]  # fmt: skip
