"""Alerts of a declared component: its one loss past what a planner wants to know, by the declaration alone."""

import numpy as np
import polars as pl
import pytest
from one_pack import FLIGHTS, departure, grid, work, work_before
from scipy.stats import norm

from hdt_core.alerts.cases import Limits
from hdt_core.alerts.component_alerts import component_features, diagnosis_of, raise_component_alerts
from hdt_core.components import components

UNIT = components()["HXT"]
WARN, FAILS = UNIT.warn_loss, UNIT.limit.mean
FLIGHT = np.arange(FLIGHTS)
NOTHING = work(departure(0), UNIT.code).clear()


def described(loss: object, **more: object) -> pl.DataFrame:
    columns = {"loss": loss, "loss_sd": 0.01, "loss_slope_30_per_flight": 0.0, "loss_step_3": 0.0} | more
    return grid(**columns).rows.with_columns(component=pl.lit(UNIT.code))


def alerts(loss: object, log: pl.DataFrame = NOTHING, **more: object) -> pl.DataFrame:
    return raise_component_alerts(described(loss, **more), log, UNIT, Limits())


@pytest.mark.parametrize(("odds", "raised"), [(0.701, 1), (0.699, 0)])
def test_a_loss_beyond_its_warning_with_probability_7_of_10(odds, raised):
    cases = alerts(WARN + 0.01 * norm.ppf(odds))
    assert cases["diagnosis"].to_list() == [UNIT.diagnosis] * raised
    assert cases["raised_flight_id"].to_list() == ["F002"] * raised
    assert cases["component"].to_list() == [UNIT.code] * raised


def test_three_flights_of_four_held_for_fifteen_above_three_quarters():
    for after, closed in ((0.749, 54), (0.75, 54), (0.751, None)):
        cases = alerts(np.where(FLIGHT < 40, 2.0 * WARN, after * WARN))
        assert cases["closed_at"].to_list() == [departure(closed) if closed else None]
    gap = np.where(np.isin(FLIGHT, (30, 32, 33)), 2.0 * WARN, 0.0)
    assert alerts(gap)["raised_flight_id"].to_list() == ["F033"]
    assert alerts(np.where(np.isin(FLIGHT, (30, 32, 34)), 2.0 * WARN, 0.0)).height == 0
    assert "since F030" in alerts(gap)["evidence"][0]


def test_work_ends_it_and_no_rows_raise_nothing():
    cases = alerts(2.0 * WARN, work_before(50, UNIT.code, UNIT.ended_by[0]))
    assert cases["closed_at"].to_list() == [departure(50), None]
    assert cases["raised_flight_id"].to_list() == ["F002", "F052"]
    others = described(0.0).with_columns(component=pl.lit("OTHER"))
    assert raise_component_alerts(others, NOTHING, UNIT, Limits()).height == 0
    early = alerts(np.where(FLIGHT < 3, 2.0 * WARN, 0.0))
    assert "since F000" in early["evidence"][0]


def test_severity_and_evidence_in_figures():
    diagnosis = diagnosis_of(UNIT, Limits())
    for loss, severity in ((0.79 * FAILS, "medium"), (0.81 * FAILS, "high")):
        facts = {"loss": loss, "loss_sd": 0.01, "loss_slope_30_per_flight": 0.0021, "loss_step_3": 0.101}
        assert diagnosis.severity(facts) == severity
        evidence = diagnosis.evidence(facts, "F07")
        assert [w.role for w in evidence.corroborations] == ["Supports" if severity == "high" else "Neutral", "Neutral"]
        text = evidence.text()
        assert f"{UNIT.lost} ({UNIT.loss}) {100 * loss:.0f} %" in text
        assert f"{loss / 0.01:.0f} times its uncertainty; above {100 * WARN:.0f} % since F07" in text
        assert "2.1 points more every ten flights" in text
        assert "10 points came within three flights" in text
        assert f"it fails at about {100 * FAILS:.0f} %" in text
    calm = {"loss": 0.3, "loss_sd": 0.0, "loss_slope_30_per_flight": 1e-5, "loss_step_3": 0.1}
    assert "points" not in diagnosis.evidence(calm, "F07").text()
    assert "points" not in diagnosis.evidence(calm | {"loss_step_3": float("nan")}, "F07").text()


def test_features_of_one_component_under_one_name():
    long = described(0.0).select("operator", "tail", "flight_id", "pack", "departed_at").with_columns(
        component=pl.lit(UNIT.code), parameter=pl.lit(UNIT.loss), value=0.001 * pl.int_range(pl.len()), sd=pl.lit(0.01),
        status=pl.lit("ok"),
    )  # fmt: skip
    other = long.with_columns(component=pl.lit("HX"), value=pl.lit(9.0))
    schema = {
        "operator": pl.String,
        "tail": pl.String,
        "flight_id": pl.String,
        "pack": pl.Int32,
        "component": pl.String,
    }
    none = pl.DataFrame(schema=schema | {"signal": pl.String, "kind": pl.String, "mean": pl.Float64})
    rows = component_features(pl.concat([long, other]), none, long, NOTHING, UNIT)
    assert rows["loss"].to_list() == pytest.approx((0.001 * FLIGHT).tolist())
    assert rows["loss_slope_30_per_flight"][-1] == pytest.approx(0.001)
    assert rows["loss_jump_10"][-1] == pytest.approx(0.01)
    assert set(rows["component"]) == {UNIT.code}
