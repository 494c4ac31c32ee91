"""Flights whose flow is in kg/min, by the aircraft's other flights."""

import polars as pl
import pytest

from hdt_core.record.flow_unit import in_other_unit
from hdt_core.record.judge import judge_flights
from tests.support.flight_lists import NOW, fleet

IN_KG = 0.45359237
NO_DELIVERIES = pl.DataFrame(schema={"operator": pl.String, "tail": pl.String, "delivered_on": pl.Date})


def flown(*flows_kg_s: float | None) -> pl.DataFrame:
    """Flights of one aircraft at these flows, and of another at half of the usual one."""
    one = fleet(len(flows_kg_s), n_aircraft=1, legs=1).with_columns(
        highest_flow_kg_s=pl.Series(flows_kg_s, dtype=pl.Float64)
    )
    other = one.with_columns(pl.col("flight_id", "tail").str.replace("AA0", "AA1"), highest_flow_kg_s=0.4)
    return pl.concat([one, other])


def held(*flows_kg_s: float | None) -> list[int]:
    """Places of the flights that are held."""
    flights = flown(*flows_kg_s).with_row_index("place")
    return flights.join(in_other_unit(flights), on="flight_id", how="semi")["place"].to_list()


@pytest.mark.parametrize("n", [1, 20])
def test_flow_in_kg_is_held(n):
    assert held(*[0.8] * 20, *[0.8 * IN_KG] * n) == list(range(20, 20 + n))


@pytest.mark.parametrize(("ratio", "n"), [(0.3, 0), (0.31, 1), (0.67, 1), (0.68, 0), (1.4, 0)])
def test_other_flows_are_flown(ratio, n):
    """A pack off, a lower schedule, one pack for two: none is nearer to the usual flow in kg/min."""
    assert len(held(*[0.8] * 20, 0.8 * ratio)) == n


@pytest.mark.parametrize(("n_usual", "n_held"), [(7, 0), (8, 3)])
def test_few_flights_show_no_usual_flow(n_usual, n_held):
    assert len(held(*[0.8] * n_usual, *[0.8 * IN_KG] * 3)) == n_held


def test_usual_flow_is_of_flights_in_pounds():
    """Most of a history may be in kg/min."""
    assert len(held(*[0.8] * 10, *[0.8 * IN_KG] * 60)) == 60


def test_missing_flow_holds_nothing():
    assert held(*[0.8] * 20, None, 0.0) == []


def test_judge_gives_unit():
    flights = flown(*[0.8] * 20, 0.8 * IN_KG)

    rows = judge_flights(flights, NO_DELIVERIES, NOW).select("reason", "is_used", "likely_cause").rows()

    assert rows == [("other_unit", False, "kg_per_minute")]
