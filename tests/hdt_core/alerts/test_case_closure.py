"""What an inspection finds answers an alert; a position that wears unit after unit is asked another question."""

from datetime import timedelta

import numpy as np
import polars as pl
import pytest
from one_pack import FLIGHTS, alerts, departure, features, work

LOOKED_AFTER, LOSS_THEN = 60, 0.2 * 59 / 60
"""Flights before an inspection, and the loss that it looks at."""


def inspection(at: int = LOOKED_AFTER, finding: str | None = "NO_FAULT_FOUND", **more: object) -> pl.DataFrame:
    """An inspection of the exchanger just before a flight."""
    entry = work(departure(at) - timedelta(minutes=5), action="INSPECTED", timed=True)
    return entry.with_columns(pl.lit(finding).alias("finding"), *(pl.lit(v).alias(k) for k, v in more.items()))


def worn(after: float) -> np.ndarray:
    """A loss that rises to 0.2 until the inspection, and by `after` in the flights that follow."""
    flight = np.arange(FLIGHTS)
    return np.where(
        flight < LOOKED_AFTER, 0.2 * flight / LOOKED_AFTER, 0.2 + after * (flight - LOOKED_AFTER) / (FLIGHTS - 60)
    )


def test_found_clean_it_closes_and_stays_closed_while_the_loss_stays() -> None:
    (alert,) = alerts(features(worn(0.0)), inspection()).to_dicts()
    assert (alert["closed_at"], alert["closed_reason"]) == (departure(LOOKED_AFTER), "found_clean")


def test_a_loss_that_grows_on_comes_back_as_the_sensors() -> None:
    first, second = alerts(features(worn(0.1)), inspection()).to_dicts()
    assert (first["diagnosis"], first["closed_reason"]) == ("HX_FOULING", "found_clean")
    assert (second["diagnosis"], second["component"], second["follows"]) == (
        "SENSOR_FAULT",
        "SENSOR",
        first["alert_id"],
    )
    assert second["closed_at"] is None
    assert second["severity"] == "medium"
    assert f"found clean on {departure(LOOKED_AFTER).date()}" in second["evidence"]
    assert "check the sensors" in second["evidence"]
    assert "neither wash nor new part yet" in second["recommended_action"]


def test_a_loss_that_grows_by_a_whole_limit_is_wear_again() -> None:
    cases = alerts(features(worn(0.25)), inspection())
    assert cases["diagnosis"].to_list() == ["HX_FOULING", "SENSOR_FAULT"], "one spell is told once"
    gap = worn(0.25)
    gap[LOOKED_AFTER + 1 : LOOKED_AFTER + 20] = 0.0  # the belief ends, and comes back higher
    cases = alerts(features(gap), inspection())
    assert cases["diagnosis"].to_list()[0] == "HX_FOULING"


@pytest.mark.parametrize(("growth", "back"), [(0.031, True), (0.029, False)])
def test_three_points_more_on_three_flights_of_four_contradict_an_inspection(growth: float, back: bool) -> None:
    loss = np.where(np.arange(FLIGHTS) < LOOKED_AFTER + 5, worn(0.0), LOSS_THEN + growth)
    cases = alerts(features(loss), inspection())
    assert cases["diagnosis"].to_list() == ["HX_FOULING"] + ["SENSOR_FAULT"] * back
    if back:
        assert cases["raised_at"].to_list()[1] == departure(LOOKED_AFTER + 7)
        assert "at a loss of 20 %, and the loss has grown to 23 %" in cases["evidence_now"].to_list()[1]


@pytest.mark.parametrize(("after", "stays"), [(0.0149, False), (0.0151, True)])
def test_a_contradiction_is_held_for_15_flights_above_half_of_it(after: float, stays: bool) -> None:
    flight = np.arange(FLIGHTS)
    loss = np.where(flight < 65, worn(0.0), np.where(flight < 70, 0.25, LOSS_THEN + after))
    second = alerts(features(loss), inspection()).row(1, named=True)
    assert (second["closed_at"], second["closed_reason"]) == ((None, None) if stays else (departure(84), "recovered"))


@pytest.mark.parametrize(("growth", "wear"), [(0.151, True), (0.149, False)])
def test_wear_is_believed_again_once_the_loss_has_grown_by_a_whole_limit(growth: float, wear: bool) -> None:
    flight = np.arange(FLIGHTS)
    loss = np.where(flight < LOOKED_AFTER, worn(0.0), np.where(flight < 80, 0.0, LOSS_THEN + growth))
    cases = alerts(features(loss).with_columns(hx_fouling_step_3=pl.lit(0.0)), inspection())
    assert ("HX_FOULING" in cases["diagnosis"].to_list()[1:]) is wear


@pytest.mark.parametrize("finding", [None, "FOULED"])
def test_an_inspection_that_found_something_or_says_nothing_ends_nothing(finding: str | None) -> None:
    (alert,) = alerts(features(worn(0.1)), inspection(finding=finding)).to_dicts()
    assert (alert["closed_at"], alert["closed_reason"]) == (None, None)


def test_the_sensors_case_ends_with_the_next_unit_and_with_a_new_sensor() -> None:
    for component in ("HX", "SENSOR"):
        new = work(departure(90) - timedelta(minutes=5), component, timed=True)
        loss = np.where((component == "HX") & (np.arange(FLIGHTS) >= 90), 0.0, worn(0.1))
        cases = alerts(features(loss), pl.concat([inspection(), new], how="diagonal"))
        assert cases["closed_at"].to_list() == [departure(LOOKED_AFTER), departure(90)]
        assert cases["closed_reason"].to_list() == ["found_clean", "renewed"]
    twice = pl.concat([inspection(), *(work(departure(k) - timedelta(minutes=5), timed=True) for k in (80, 95))])
    later = np.where(np.arange(FLIGHTS) < 85, worn(0.0), worn(0.0) + 0.05)  # the next unit wears by itself
    assert alerts(features(later), twice)["diagnosis"].to_list() == ["HX_FOULING"] * 2


def test_an_inspection_since_the_last_flight_closes_it_at_once() -> None:
    (alert,) = alerts(features(worn(0.0)), inspection(FLIGHTS)).to_dicts()
    assert (alert["closed_at"], alert["closed_reason"]) == (departure(FLIGHTS) - timedelta(minutes=5), "found_clean")


def test_what_an_inspection_says_changes_nothing_before_it() -> None:
    rows = features(worn(0.1))
    with_it, without = (alerts(rows.head(LOOKED_AFTER), m) for m in (inspection(), inspection().clear()))
    assert with_it.drop("closed_at", "closed_reason").equals(without.drop("closed_at", "closed_reason"))


def test_an_alert_that_only_its_name_ends() -> None:
    """Little margin is not what an exchanger's inspection is about, unless an engineer says so of that very alert."""
    rows = features(np.full(FLIGHTS, 0.05), hx_passage_300=np.full(FLIGHTS, 0.99), hx_margin_k=np.full(FLIGHTS, 1.0))
    (alert,) = alerts(rows, inspection()).to_dicts()
    assert (alert["diagnosis"], alert["closed_at"]) == ("HX_LOW_MARGIN", None)
    (alert,) = alerts(rows, inspection(closes_alert_id=alert["alert_id"])).to_dicts()
    assert alert["closed_reason"] == "found_clean"


@pytest.mark.parametrize(("days", "units"), [((30, 60), 3), ((1, 60), 2), ((60,), 2), ((), 1)])
def test_the_third_unit_in_ninety_days_asks_for_the_cause_upstream(days: tuple[int, ...], units: int) -> None:
    """Flights begin on day 0, the alert is raised on day 100 or so."""
    flight = np.arange(4 * 110)
    loss = np.where(flight < 4 * 98, 0.01, 0.01 + 0.005 * (flight - 4 * 98))
    work_done = [work(departure(4 * d), timed=True) for d in days]
    log = pl.concat(work_done) if days else work(departure(0)).clear()
    (alert,) = alerts(features(loss), log).to_dicts()
    assert alert["units_in_90_days"] == units
    assert alert["recommended_action"].startswith("Find the cause upstream") == (units >= 3)


@pytest.mark.parametrize(("late_s", "units"), [(0, 2), (1, 3)])
def test_units_count_from_ninety_days_before_the_alert(late_s: int, units: int) -> None:
    flight = np.arange(4 * 110)
    rows = features(np.where(flight < 4 * 98, 0.01, 0.01 + 0.005 * (flight - 4 * 98)))
    raised = alerts(rows, work(departure(0)).clear())["raised_at"][0]
    log = [work(raised - timedelta(days=90, seconds=-late_s), timed=True), work(departure(4 * 60), timed=True)]
    assert alerts(rows, pl.concat(log))["units_in_90_days"].to_list() == [units]
