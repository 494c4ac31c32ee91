"""Two aircraft whose flights were delivered under each other's tail for some days."""

import numpy as np
import polars as pl
import pytest

from hdt_core.record.exchange import BETWEEN_PACKS
from hdt_core.record.judge import judge_flights
from hdt_core.record.two_aircraft import of_two_aircraft
from tests.support.flight_lists import NOW, fleet

NAMES = list(BETWEEN_PACKS)
N_DAYS, LEGS, N_AIRCRAFT = 24, 3, 3
USUAL = np.array([[3.0, -2.0, 1.5, 0.5, -1.5, 1.0, 2.0, 0.0], [0.0] * 8, [3.0, 3.0, -1.5, -2.5, 1.5, 3.0, 2.0, -2.0]])
"""How the packs of each aircraft differ, in standard deviations from flight to flight."""
PAIR = {"LX-AA0": "LX-AA2", "LX-AA2": "LX-AA0"}
BEGIN, END = 10, 16
"""Days of the record between which the two are exchanged."""


@pytest.fixture(scope="module")
def good() -> pl.DataFrame:
    """Flights of three aircraft, each with its own differences."""
    noise = np.random.default_rng(7).normal(0.0, 1.0, (N_AIRCRAFT, N_DAYS * LEGS, len(NAMES)))
    columns = (USUAL[:, np.newaxis] + noise).reshape(-1, len(NAMES)).T
    flights = fleet(N_DAYS, N_AIRCRAFT, LEGS).sort("tail", "departed_at")
    day = (pl.col("departed_at") - pl.col("departed_at").min()).dt.total_days()
    return flights.with_columns(pl.Series(n, c) for n, c in zip(NAMES, columns, strict=True)).with_columns(day=day)


def exchange(flights: pl.DataFrame, begin: int, end: int) -> pl.DataFrame:
    """Deliver the flights of some days under the other aircraft's tail."""
    is_exchanged = pl.col("day").is_between(begin, end, closed="left")
    other = (pl.col(name).str.replace_many(PAIR) for name in ("tail", "flight_id"))
    return flights.with_columns(pl.when(is_exchanged).then(new).otherwise(new.meta.output_name()) for new in other)


def held_days(flights: pl.DataFrame) -> dict[str, list[int]]:
    """Days of each aircraft whose flights are held."""
    held = flights.join(of_two_aircraft(flights), on="flight_id", how="semi")
    days = held.group_by("tail").agg(pl.col("day").unique().sort())
    return dict(days.sort("tail").iter_rows())


def test_exchanged_days_are_held(good):
    days = list(range(BEGIN, END))

    assert held_days(exchange(good, BEGIN, END)) == {"LX-AA0": days, "LX-AA2": days}


def test_good_flights_stay(good):
    assert held_days(good) == {}


def test_exchange_without_end_is_held(good):
    days = list(range(BEGIN, N_DAYS))

    assert held_days(exchange(good, BEGIN, N_DAYS)) == {"LX-AA0": days, "LX-AA2": days}


@pytest.mark.parametrize(("n_days", "n_held"), [(1, 0), (2, 12)])
def test_first_days_wait(good, n_days, n_held):
    """Five flights of each aircraft show it."""
    flights = exchange(good, BEGIN, END).filter(pl.col("day") < BEGIN + n_days)

    assert of_two_aircraft(flights).height == n_held


def test_second_exchange_is_held(good):
    flights = exchange(exchange(good, 6, 9), 14, 18)

    assert held_days(flights)["LX-AA0"] == [6, 7, 8, 14, 15, 16, 17]


def test_verdict_names_other_aircraft(good):
    flights = exchange(good, BEGIN, END)

    first = of_two_aircraft(flights).filter(pl.col("flight_id").str.starts_with("LX-AA0")).row(0, named=True)

    before = flights.filter(pl.col("tail") == "LX-AA2", pl.col("day") < BEGIN).sort("departed_at")["flight_id"][-1]
    assert (first["likely_cause"], first["other_flight_id"]) == ("aircraft_LX-AA2", before)


def test_order_of_rows_plays_no_part(good):
    flights = exchange(good, BEGIN, END)
    shuffled = flights.sample(fraction=1.0, shuffle=True, seed=3)

    verdicts = [of_two_aircraft(rows).sort("flight_id") for rows in (flights, shuffled)]

    assert verdicts[0].equals(verdicts[1])


def test_nights_end_with_the_same_verdict(good):
    """Each night judges the record as it is: what is held at its end is what one night holds."""
    flights = exchange(good, BEGIN, END)
    nights = [of_two_aircraft(flights.filter(pl.col("day") <= day)) for day in range(BEGIN, N_DAYS)]

    assert nights[-1].equals(of_two_aircraft(flights))


def changed(flights: pl.DataFrame, tail: str, step: np.ndarray) -> pl.DataFrame:
    """Change a unit of an aircraft: its differences move by a step."""
    is_later = (pl.col("tail") == tail) & (pl.col("day") >= BEGIN)
    steps = dict(zip(NAMES, step, strict=True))
    return flights.with_columns(pl.when(is_later).then(pl.col(n) + steps[n]).otherwise(n).alias(n) for n in NAMES)


def test_aircraft_that_becomes_like_another_stays(good):
    assert held_days(changed(good, "LX-AA0", USUAL[2] - USUAL[0])) == {}


def test_packs_exchanged_on_all_aircraft_are_no_exchange(good):
    """A map for all aircraft; two of which have the packs' differences of the other, exchanged."""
    opposite = changed(good, "LX-AA2", np.zeros(8)).with_columns(
        pl.when(pl.col("tail") == "LX-AA2").then(pl.col(n) - a - b).otherwise(n).alias(n)
        for n, a, b in zip(NAMES, USUAL[2], USUAL[0], strict=True)
    )
    is_later = pl.col("day") >= BEGIN
    flights = opposite.with_columns(pl.when(is_later).then(-pl.col(n)).otherwise(n).alias(n) for n in NAMES)

    assert held_days(flights) == {}


def test_other_operators_take_no_part(good):
    operator = pl.when(pl.col("tail") == "LX-AA2").then(pl.lit("BZR")).otherwise("operator")
    flights = exchange(good, BEGIN, END).with_columns(operator=operator)

    assert held_days(flights) == {}


def test_held_flights_are_released_when_delivered_right(good):
    no_deliveries = pl.DataFrame(schema={"operator": pl.String, "tail": pl.String, "delivered_on": pl.Date})
    flights = exchange(good, BEGIN, END).drop("day")

    held = judge_flights(flights, no_deliveries, NOW)

    assert held.select("reason", "is_used").unique().rows() == [("misfiled", False)]
    assert judge_flights(good.drop("day"), no_deliveries, NOW).is_empty()
