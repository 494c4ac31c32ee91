"""Flights that another aircraft flew, by what distinguishes its two packs."""

from math import sqrt

import numpy as np
import polars as pl
import pytest

from hdt_core.record.exchange import BETWEEN_PACKS
from hdt_core.record.judge import judge_flights
from hdt_core.record.misfiled import misfiled
from hdt_core.robust import MAD_TO_SD
from tests.support.flight_lists import NOW, fleet

NAMES = list(BETWEEN_PACKS)
N_DAYS, LEGS, N_AIRCRAFT = 20, 3, 3
N_FLIGHTS = N_DAYS * LEGS
PLACE = 30
"""Place of the flight that is changed, in order of departure."""
USUAL = np.array([[3.0, -2.0, 1.5, 0.5, -1.5, 1.0, 2.0, 0.0], [0.0] * 8, [-3.0, -3.0, -1.5, 2.5, 1.5, 3.0, -2.0, 2.0]])
"""How the packs of each aircraft differ, in standard deviations from flight to flight."""


@pytest.fixture
def differences() -> np.ndarray:
    """How the packs differ on each flight: aircraft, flight, signal."""
    noise = np.random.default_rng(7).normal(0.0, 1.0, (N_AIRCRAFT, N_FLIGHTS, len(NAMES)))
    return USUAL[:, np.newaxis] + noise


def listed(differences: np.ndarray) -> pl.DataFrame:
    """The flights that show these differences."""
    flights = fleet(N_DAYS, N_AIRCRAFT, LEGS).sort("tail", "departed_at")
    columns = differences.reshape(-1, len(NAMES)).T
    values = (pl.Series(name, column, nan_to_null=True) for name, column in zip(NAMES, columns, strict=True))
    return flights.with_columns(values)


def held_places(flights: pl.DataFrame) -> list[tuple[str, int]]:
    """Tail and place of each flight that is held as another aircraft's."""
    placed = flights.with_columns(place=pl.int_range(pl.len()).over("tail"))
    return placed.join(misfiled(flights), on="flight_id", how="semi").select("tail", "place").rows()


def test_flight_of_other_aircraft_is_held(differences):
    differences[0, PLACE] = USUAL[2]

    assert held_places(listed(differences)) == [("LX-AA0", PLACE)]


def test_good_flights_are_not_misfiled(differences):
    assert held_places(listed(differences)) == []


def test_verdict_names_aircraft_that_flew(differences):
    """By its flight before."""
    differences[0, PLACE] = USUAL[2]
    flights = listed(differences)

    before = flights.filter(tail="LX-AA2")["flight_id"][PLACE - 1]
    assert misfiled(flights)["other_flight_id"].to_list() == [before]


def test_single_exchange_of_packs_is_named(differences):
    differences[0, PLACE] = -USUAL[0]

    verdict = misfiled(listed(differences)).select("reason", "other_flight_id")

    assert verdict.rows() == [("packs_exchanged", None)]


def test_packs_that_read_alike_are_not_exchanged(differences):
    differences[1, PLACE] = -differences[1, PLACE]

    assert held_places(listed(differences)) == []


def test_strange_flight_like_none_stays(differences):
    differences[0, PLACE] = USUAL[0] + 6.0

    assert held_places(listed(differences)) == []


@pytest.mark.parametrize("n_after", [1, 2, 7, 8, 30])
def test_changed_unit_holds_no_flight(differences, n_after):
    """From one flight on the packs differ as another aircraft's do."""
    differences[0, PLACE:] += USUAL[2] - USUAL[0]
    flights = listed(differences).filter(pl.int_range(pl.len()).over("tail") < PLACE + n_after)

    assert held_places(flights) == []


@pytest.mark.parametrize("n", [2, 3, 6])
def test_flights_that_agree_are_not_misfiled(differences, n):
    differences[0, PLACE : PLACE + n] = USUAL[2]

    assert held_places(listed(differences)) == []


@pytest.mark.parametrize(("n_after", "n_held"), [(7, 0), (8, 1)])
def test_misfiled_flight_waits_for_later_ones(differences, n_after, n_held):
    differences[0, PLACE] = USUAL[2]
    flights = listed(differences).filter(pl.int_range(pl.len()).over("tail") <= PLACE + n_after)

    assert len(held_places(flights)) == n_held


@pytest.mark.parametrize(("n_missing", "n_held"), [(2, 1), (3, 0)])
def test_missing_signals_take_no_part(differences, n_missing, n_held):
    """Six of eight are enough."""
    differences[0, PLACE] = USUAL[2]
    differences[:, :, -n_missing:] = np.nan

    assert len(held_places(listed(differences))) == n_held


def steady(*usual: float) -> np.ndarray:
    """Differences about a level of each aircraft, up and down by turns: their standard deviation is estimated as 1."""
    swing = sqrt(2.0) / (2.0 * MAD_TO_SD) * (-1.0) ** np.arange(N_FLIGHTS)
    levels = np.array(usual)[:, np.newaxis] + swing
    return np.repeat(levels[:, :, np.newaxis], len(NAMES), axis=2)


def is_held(differences: np.ndarray) -> bool:
    """Whether the changed flight of the first aircraft is held."""
    return ("LX-AA0", PLACE) in held_places(listed(differences))


@pytest.mark.parametrize(
    ("others", "sds", "held"),
    [((np.nan,), 1.57, False), ((np.nan,), 1.59, True), ((90.0,), 1.73, False), ((90.0,), 1.74, True)],
)
def test_margin_grows_with_the_fleet(others, sds, held):
    """The mean square must be 2.5 with one aircraft to compare with, 3 with two."""
    differences = steady(0.0, sds, *others)
    differences[0, PLACE] = sds

    assert is_held(differences) is held


@pytest.mark.parametrize(("sds", "held"), [(1.73, True), (1.74, False)])
def test_flight_is_like_within_limit(sds, held):
    """A mean square of 3 from the other aircraft."""
    differences = steady(0.0, 9.0, 90.0)
    differences[0, PLACE] = 9.0 + sds

    assert is_held(differences) is held


@pytest.mark.parametrize(("sds", "held"), [(2.01, True), (1.99, False)])
def test_neighbours_agree_within_limit(sds, held):
    """A mean square of 2 from the next flight, over the noise of both."""
    differences = steady(0.0, 9.0, 90.0)
    differences[0, PLACE] = 9.0
    differences[0, PLACE + 1] = 9.0 - sds

    assert is_held(differences) is held


@pytest.mark.parametrize(("n_sensors", "held"), [(1, False), (2, True)])
def test_single_sensor_misfiles_no_flight(n_sensors, held):
    """Each counts four standard deviations at most, a mean square of 2 in eight signals."""
    differences = steady(0.0, 0.0, 90.0)
    differences[1, :, :n_sensors] += 20.0
    differences[0, PLACE, :n_sensors] = 20.0

    assert is_held(differences) is held


@pytest.mark.parametrize(("swing", "held"), [(1.0, True), (4.0, False)])
def test_scatter_makes_a_flight_usual(differences, swing, held):
    """What is far from an aircraft whose flights are alike is near to one whose flights are not."""
    differences[0] = USUAL[0] + swing * (differences[0] - USUAL[0])
    differences[0, PLACE] = USUAL[2]

    assert is_held(differences) is held


def test_scattered_aircraft_draws_no_flight(differences):
    """A flight that is like no aircraft is not like one whose flights scatter."""
    differences[2] = USUAL[2] + 9.0 * (differences[2] - USUAL[2])
    differences[0, PLACE] = USUAL[0] + 9.0

    assert not is_held(differences)


def test_other_operators_take_no_part(differences):
    differences[0, PLACE] = USUAL[2]
    flights = listed(differences)
    is_like = pl.col("tail") == "LX-AA2"
    moved = flights.with_columns(operator=pl.when(is_like).then(pl.lit("BZR")).otherwise("operator"))

    assert held_places(moved) == []


def test_judge_holds_misfiled_flight(differences):
    differences[0, PLACE] = USUAL[2]
    no_deliveries = pl.DataFrame(schema={"operator": pl.String, "tail": pl.String, "delivered_on": pl.Date})

    rows = judge_flights(listed(differences), no_deliveries, NOW)

    assert rows.select("reason", "is_used").rows() == [("misfiled", False)]
