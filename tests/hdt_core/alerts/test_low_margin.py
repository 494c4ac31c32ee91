"""Alerts of a pack without reserve though hardly worn, and of a declared component by its declaration alone."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest
from one_pack import FLIGHTS, departure, grid, work, work_before
from scipy.stats import norm

from hdt_core.alerts.alerts import component_features, diagnosis_of, raise_alerts, raise_component_alerts
from hdt_core.alerts.cases import Limits
from hdt_core.alerts.facts import LossFacts
from hdt_core.components import components

SHORT = 40


def fleet(passage: float, loss: float, flights: int = SHORT) -> pl.DataFrame:
    start = datetime(2024, 5, 1, 6, tzinfo=UTC)
    at = [start + timedelta(hours=8 * k) for k in range(flights)]
    rows = pl.DataFrame({"departed_at": at, "flight_id": [f"LX-T01_{d:%Y%m%d}_{d.hour // 8 + 1:02d}" for d in at]})
    late = pl.int_range(pl.len()) >= 10
    return rows.with_columns(
        pl.col("departed_at").cast(pl.Datetime("us", "UTC")),
        operator=pl.lit("XXX"), tail=pl.lit("LX-T01"), pack=pl.lit(1, pl.Int32),
        hx_fouling=pl.when(late).then(loss).otherwise(0.0), hx_fouling_sd=pl.lit(0.01),
        hx_fouling_flight=pl.when(late).then(loss).otherwise(0.0),
        hx_fouling_slope_30_per_flight=pl.lit(0.0002), hx_fouling_slope_100_per_flight=pl.lit(0.0002),
        hx_fouling_step_3=pl.lit(0.0), running=pl.lit(True), door_full_open_share=pl.lit(0.3),
        hx_passage_100=pl.when(late).then(passage / 2).otherwise(0.0),
        hx_passage_300=pl.when(late).then(passage).otherwise(0.0),
        hx_margin_k=pl.lit(-2.0), hx_margin_hot_day_k=pl.lit(-7.0), hx_margin_design_k=pl.lit(6.0),
        hx_margin_ambient_k=pl.lit(-8.0), overheat_p20_k=pl.lit(2.0),
    )  # fmt: skip


LOG = pl.DataFrame(
    schema={
        "operator": pl.String, "tail": pl.String, "pack": pl.Int32, "done_on": pl.Date, "component": pl.String,
        "action": pl.String,
    }
)  # fmt: skip


def hx(alerts: pl.DataFrame) -> list[str]:
    return alerts.filter(component="HX")["diagnosis"].to_list()


def test_low_margin_is_its_own_diagnosis():
    cases = raise_alerts(fleet(0.97, 0.04), LOG)
    assert hx(cases) == ["HX_LOW_MARGIN"]
    row = cases.row(0, named=True)
    assert "2 K above its level" in row["evidence"]
    assert "7 K above it on a hot day" in row["evidence"]
    assert "air outside -8 K" in row["evidence"]
    assert "a new exchanger alone does not remove the cause" in row["recommended_action"]
    assert row["closed_at"] is None
    assert hx(raise_alerts(fleet(0.97, 0.25), LOG)) == ["HX_FOULING"]


def test_new_unit_closes_low_margin():
    flights = fleet(0.97, 0.04)
    done = flights["departed_at"][25].date()
    log = pl.DataFrame(
        {
            "operator": ["XXX"], "tail": ["LX-T01"], "pack": [1], "done_on": [done], "component": ["HX"],
            "action": ["REPLACED"],
        },
        schema=LOG.schema,
    )  # fmt: skip
    cases = raise_alerts(flights, log).filter(diagnosis="HX_LOW_MARGIN").sort("raised_at")
    assert cases["closed_at"][0] is not None
    assert cases["closed_at"][0].date() > done
    # the next unit has as little reserve, and its message may come within twenty flights
    assert cases["raised_at"].to_list()[1] - cases["closed_at"][0] <= timedelta(hours=8 * 7)


def two_hot_weeks(later_loss: float = 0.04) -> pl.DataFrame:
    """A hardly worn exchanger with little margin on flights 10 to 29 and from 60 on, of `later_loss` from 70 on."""
    flights = fleet(0.97, 0.04, flights=100)
    index = pl.int_range(pl.len())
    loss = pl.when(index >= 70).then(later_loss).otherwise("hx_fouling")
    soon = pl.when(index.is_between(30, 59)).then(0.0).otherwise("hx_passage_300")
    return flights.with_columns(hx_fouling=loss, hx_fouling_flight=loss, hx_passage_300=soon)


def between(flights: pl.DataFrame, action: str) -> pl.DataFrame:
    done = flights["departed_at"][45].date()
    return pl.DataFrame([("XXX", "LX-T01", 1, done, "HX", action)], schema=LOG.schema, orient="row")


@pytest.mark.parametrize(("action", "n_cases"), [("INSPECTED", 1), ("CLEANED", 1), ("REPLACED", 2)])
def test_low_margin_by_design_is_reported_once(action, n_cases):
    flights = two_hot_weeks()

    cases = raise_alerts(flights, between(flights, action))

    assert hx(cases) == ["HX_LOW_MARGIN"] * n_cases


def test_low_margin_is_reported_again_once_worn():
    flights = two_hot_weeks(later_loss=0.08)

    cases = raise_alerts(flights, between(flights, "CLEANED"))

    assert cases["raised_at"].to_list()[1:] == [flights["departed_at"][70]]


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
def test_component_alert_needs_seventy_percent(odds, raised):
    cases = alerts(WARN + 0.01 * norm.ppf(odds))
    assert cases["diagnosis"].to_list() == [UNIT.diagnosis] * raised
    assert cases["raised_flight_id"].to_list() == ["F002"] * raised
    assert cases["component"].to_list() == [UNIT.code] * raised


def test_component_alert_persists_fifteen_flights():
    for after, closed in ((0.749, 54), (0.75, 54), (0.751, None)):
        cases = alerts(np.where(FLIGHT < 40, 2.0 * WARN, after * WARN))
        assert cases["closed_at"].to_list() == [departure(closed) if closed else None]
    gap = np.where(np.isin(FLIGHT, (30, 32, 33)), 2.0 * WARN, 0.0)
    assert alerts(gap)["raised_flight_id"].to_list() == ["F033"]
    assert alerts(np.where(np.isin(FLIGHT, (30, 32, 34)), 2.0 * WARN, 0.0)).height == 0
    assert "since F030" in alerts(gap)["evidence"][0]
    cases = alerts(2.0 * WARN, work_before(50, UNIT.code, UNIT.ended_by[0]))
    assert cases["closed_at"].to_list() == [departure(50), None]
    assert cases["raised_flight_id"].to_list() == ["F002", "F052"]
    others = described(0.0).with_columns(component=pl.lit("OTHER"))
    assert raise_component_alerts(others, NOTHING, UNIT, Limits()).height == 0
    early = alerts(np.where(FLIGHT < 3, 2.0 * WARN, 0.0))
    assert "since F000" in early["evidence"][0]


def test_component_evidence_states_figures():
    diagnosis = diagnosis_of(UNIT, Limits())
    for loss, severity in ((0.79 * FAILS, "medium"), (0.81 * FAILS, "high")):
        facts = LossFacts(loss=loss, loss_sd=0.01, loss_slope_30_per_flight=0.0021, loss_step_3=0.101)
        assert diagnosis.severity(facts) == severity
        evidence = diagnosis.evidence(facts, "F07")
        assert [w.role for w in evidence.corroborations] == ["Supports" if severity == "high" else "Neutral", "Neutral"]
        text = evidence.text()
        assert f"{UNIT.lost} ({UNIT.loss}) {100 * loss:.0f} %" in text
        assert f"{loss / 0.01:.0f} times its uncertainty; above {100 * WARN:.0f} % since F07" in text
        assert "2.1 points more every ten flights" in text
        assert "10 points came within three flights" in text
        assert f"it fails at about {100 * FAILS:.0f} %" in text
    calm = LossFacts(loss=0.3, loss_sd=0.0, loss_slope_30_per_flight=1e-5, loss_step_3=0.1)
    assert "points" not in diagnosis.evidence(calm, "F07").text()
    assert "points" not in diagnosis.evidence(replace(calm, loss_step_3=float("nan")), "F07").text()


def test_component_features_share_one_name():
    long = described(0.0).select("operator", "tail", "flight_id", "pack", "departed_at").with_columns(
        component=pl.lit(UNIT.code), parameter=pl.lit(UNIT.loss), value=0.001 * pl.int_range(pl.len()), sd=pl.lit(0.01),
        status=pl.lit("ok"),
    )  # fmt: skip
    other = long.with_columns(component=pl.lit("HX"), value=pl.lit(9.0))
    schema = {
        "operator": pl.String, "tail": pl.String, "flight_id": pl.String, "pack": pl.Int32, "component": pl.String,
    }  # fmt: skip
    none = pl.DataFrame(schema=schema | {"signal": pl.String, "kind": pl.String, "mean": pl.Float64})
    rows = component_features(pl.concat([long, other]), none, long, NOTHING, UNIT)
    assert rows["loss"].to_list() == pytest.approx((0.001 * FLIGHT).tolist())
    assert rows["loss_slope_30_per_flight"][-1] == pytest.approx(0.001)
    assert rows["loss_jump_10"][-1] == pytest.approx(0.01)
    assert set(rows["component"]) == {UNIT.code}
