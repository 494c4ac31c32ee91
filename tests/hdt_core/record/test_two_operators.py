"""Flights of one tail under two operators: copies are held once, flights of two aircraft stay."""

import polars as pl
import pytest

from hdt_core.record.judge import judge_flights
from hdt_core.record.overlap import SAME_MEANS
from hdt_core.tables.raw import RawFlights
from tests.support.flight_lists import NOW, fleet

LINES = {"operator": pl.String, "tail": pl.String, "delivered_on": pl.Date}


@pytest.fixture(scope="module")
def good() -> pl.DataFrame:
    return fleet(10)


@pytest.fixture
def own(good) -> pl.DataFrame:
    """Flights of the aircraft whose folder is copied."""
    return good.filter(tail="LX-AA1").sort("departed_at")


def under(operator: str, flights: pl.DataFrame, **changes: object) -> pl.DataFrame:
    return RawFlights.conform(flights.with_columns(operator=pl.lit(operator), **changes))


def held(*parts: pl.DataFrame, lines: list[str] | None = None) -> pl.DataFrame:
    listed = pl.DataFrame([(o, "LX-AA1", None) for o in lines or []], schema=LINES, orient="row")
    return judge_flights(pl.concat(parts), listed, NOW)


def test_copied_flights_are_held(good, own):
    rows = held(good, under("BBB", own[5:12]))
    expected = [("BBB", name, "copy_of_flight", "operator_AQX", name) for name in own["flight_id"][5:12]]
    assert rows.select("operator", "flight_id", "reason", "likely_cause", "other_flight_id").rows() == expected


def test_operator_with_more_flights_keeps_them(good, own):
    rows = held(good.join(own[-1:], on="flight_id", how="anti"), under("BBB", own))
    assert rows.select("operator", "flight_id").rows() == [("AQX", name) for name in own["flight_id"][:-1]]


@pytest.mark.parametrize(("lines", "operator"), [(["AQX"], "BBB"), (["BBB"], "AQX"), ([], "BBB")])
def test_listed_operator_keeps_a_whole_copy(good, own, lines, operator):
    assert held(good, under("BBB", own), lines=lines)["operator"].unique().to_list() == [operator]


def test_third_copy_is_held_too(good, own):
    rows = held(good, under("BBB", own[:5]), under("CCC", own[:3]))
    causes = rows.select("operator", "likely_cause").rows()
    assert causes == [*[("BBB", "operator_AQX")] * 5, *[("CCC", "operator_AQX")] * 3]


def test_flights_of_one_operator_alone_are_released(good, own):
    rest = good.join(own, on="flight_id", how="anti")
    assert held(rest, under("BBB", own)).is_empty()


@pytest.mark.parametrize("end", ["departed_at", "landed_at"])
@pytest.mark.parametrize(("seconds", "n_held"), [(60, 1), (61, 0)])
def test_copy_begins_and_ends_together(good, own, end, seconds, n_held):
    later = under("BBB", own[5:6], **{end: pl.col(end).dt.offset_by(f"{seconds}s")})
    assert held(good, later).height == n_held


@pytest.mark.parametrize(("name", "tolerance"), SAME_MEANS.items())
@pytest.mark.parametrize(("share", "n_held"), [(0.99, 1), (1.01, 0)])
def test_copy_has_equal_means(good, own, name, tolerance, share, n_held):
    other = under("BBB", own[5:6], **{name: pl.col(name) + share * tolerance})
    assert held(good, other).height == n_held


@pytest.mark.parametrize(("unrecorded", "n_held"), [(["mean_hx_in_k"], 1), (list(SAME_MEANS), 0)])
def test_copy_lacks_what_the_flight_lacks(good, own, unrecorded, n_held):
    poor = own[5:6].with_columns(pl.lit(None, pl.Float64).alias(name) for name in unrecorded)
    assert held(good.join(poor, on="flight_id", how="anti"), poor, under("BBB", poor)).height == n_held


def test_second_aircraft_of_a_tail_is_not_touched(good, own):
    assert held(good, under("BBB", own, mean_tat_k=pl.col("mean_tat_k") + 1.0)).is_empty()


@pytest.mark.parametrize("change", [pl.col("flight_id").str.replace(r"_0(.)$", "_2$1"), "DDD." + pl.col("flight_id")])
def test_copy_may_have_another_number(good, own, change):
    """Or the prefix of a tail that came back to its airframe."""
    assert held(good, under("BBB", own[5:8], flight_id=change))["other_flight_id"].to_list() == [*own["flight_id"][5:8]]
