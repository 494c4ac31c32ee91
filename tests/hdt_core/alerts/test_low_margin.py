"""Alerts of a pack without reserve though hardly worn, and of a declared component by its declaration alone."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest
from one_pack import FLIGHTS, departure, grid, work, work_before
from scipy.stats import norm
from twin_flights import NO_LOG

from hdt_core.alerts.alerts import raise_alerts
from hdt_core.alerts.cases import Limits
from hdt_core.alerts.component_alerts import LossFacts, component_features, diagnosis_of, raise_component_alerts
from hdt_core.alerts.evidence import Evidence
from hdt_core.components import components

SHORT = 40


def fleet(passage: float, loss: float, flights: int = SHORT) -> pl.DataFrame:
    """One pack, sound for ten flights; then of so much loss, and so likely to bring a message within 300."""
    start = datetime(2024, 5, 1, 6, tzinfo=UTC)
    at = [start + timedelta(hours=8 * k) for k in range(flights)]
    late = np.arange(flights) >= 10
    columns = {
        "operator": "XXX", "tail": "LX-T01", "pack": 1, "departed_at": at,
        "flight_id": [f"LX-T01_{d:%Y%m%d}_{d.hour // 8 + 1:02d}" for d in at],
        "hx_fouling": loss * late, "hx_fouling_sd": 0.01, "hx_fouling_flight": loss * late,
        "hx_fouling_slope_30_per_flight": 0.0002, "hx_fouling_slope_100_per_flight": 0.0002, "hx_fouling_step_3": 0.0,
        "running": True, "door_full_open_share": 0.3, "hx_passage_100": passage / 2 * late,
        "hx_passage_300": passage * late, "hx_margin_k": -2.0, "hx_margin_hot_day_k": -7.0, "hx_margin_design_k": 6.0,
        "hx_margin_ambient_k": -8.0, "overheat_p20_k": 2.0,
    }  # fmt: skip
    return pl.DataFrame(columns).cast({"pack": pl.Int32, "departed_at": pl.Datetime("us", "UTC")})


def work_at(flights: pl.DataFrame, index: int, action: str) -> pl.DataFrame:
    """Work on the exchanger on the day of a flight."""
    row = ("XXX", "LX-T01", 1, "HX", action, flights["departed_at"][index].date())
    return pl.DataFrame([row], NO_LOG.schema, orient="row")


def hx(alerts: pl.DataFrame) -> list[str]:
    return alerts.filter(component="HX")["diagnosis"].to_list()


def test_low_margin_is_its_own_diagnosis():
    cases = raise_alerts(fleet(0.97, 0.04), NO_LOG)
    row = cases.row(0, named=True)
    assert hx(cases) == ["HX_LOW_MARGIN"]
    for words in ("2 K above its level", "7 K above it on a hot day", "air outside -8 K"):
        assert words in row["evidence"]
    assert "a new exchanger alone does not remove the cause" in row["recommended_action"]
    assert row["closed_at"] is None


def test_worn_exchanger_is_diagnosed_as_worn():
    assert hx(raise_alerts(fleet(0.97, 0.25), NO_LOG)) == ["HX_FOULING"]


def test_new_unit_closes_low_margin():
    """The next unit has as little reserve, and its message may come within twenty flights."""
    flights = fleet(0.97, 0.04)
    cases = raise_alerts(flights, work_at(flights, 25, "REPLACED")).filter(diagnosis="HX_LOW_MARGIN").sort("raised_at")
    assert cases["closed_at"][0].date() > flights["departed_at"][25].date()
    assert cases["raised_at"][1] - cases["closed_at"][0] <= timedelta(hours=8 * 7)


def two_hot_weeks(later_loss: float = 0.04) -> pl.DataFrame:
    """A hardly worn exchanger with little margin on flights 10 to 29 and from 60 on, of `later_loss` from 70 on."""
    flights = fleet(0.97, 0.04, flights=100)
    index = pl.int_range(pl.len())
    loss = pl.when(index >= 70).then(later_loss).otherwise("hx_fouling")
    soon = pl.when(index.is_between(30, 59)).then(0.0).otherwise("hx_passage_300")
    return flights.with_columns(hx_fouling=loss, hx_fouling_flight=loss, hx_passage_300=soon)


@pytest.mark.parametrize(("action", "n_cases"), [("INSPECTED", 1), ("CLEANED", 1), ("REPLACED", 2)])
def test_low_margin_is_reported_once(action, n_cases):
    """It is by design until there is another unit."""
    flights = two_hot_weeks()

    cases = raise_alerts(flights, work_at(flights, 45, action))

    assert hx(cases) == ["HX_LOW_MARGIN"] * n_cases


def test_wear_reports_low_margin_again():
    flights = two_hot_weeks(later_loss=0.08)

    cases = raise_alerts(flights, work_at(flights, 45, "CLEANED"))

    assert cases["raised_at"].to_list()[1:] == [flights["departed_at"][70]]


UNIT = components()["HXT"]
WARN = UNIT.warn_loss
FAILS = UNIT.limit.mean
FLIGHT = np.arange(FLIGHTS)
NOTHING = work(departure(0), UNIT.code).clear()


def component_rows(loss: object, **more: object) -> pl.DataFrame:
    columns = {"loss": loss, "loss_sd": 0.01, "loss_slope_30_per_flight": 0.0, "loss_step_3": 0.0} | more
    return grid(**columns).rows.with_columns(component=pl.lit(UNIT.code))


def alerts(loss: object, log: pl.DataFrame = NOTHING, **more: object) -> pl.DataFrame:
    return raise_component_alerts(component_rows(loss, **more), log, UNIT, Limits())


@pytest.mark.parametrize(("odds", "raised"), [(0.701, 1), (0.699, 0)])
def test_component_alert_needs_seventy_percent(odds, raised):
    cases = alerts(WARN + 0.01 * norm.ppf(odds)).select("diagnosis", "raised_flight_id", "component")
    assert cases.rows() == [(UNIT.diagnosis, "F002", UNIT.code)] * raised


@pytest.mark.parametrize(("after", "closed"), [(0.749, departure(54)), (0.75, departure(54)), (0.751, None)])
def test_component_alert_persists_fifteen_flights(after, closed):
    """After its loss fell to three quarters of the warning."""
    cases = alerts(np.where(FLIGHT < 40, 2.0 * WARN, after * WARN))
    assert cases["closed_at"].to_list() == [closed]


@pytest.mark.parametrize(("flights", "raised"), [((30, 32, 33), ["F033"]), ((30, 32, 34), [])])
def test_component_alert_needs_three_flights(flights, raised):
    """Of four."""
    cases = alerts(np.where(np.isin(FLIGHT, flights), 2.0 * WARN, 0.0))
    assert cases["raised_flight_id"].to_list() == raised


@pytest.mark.parametrize(("flights", "first"), [((30, 32, 33), "F030"), ((0, 1, 2), "F000")])
def test_component_evidence_states_first_flight(flights, first):
    assert f"since {first}" in alerts(np.where(np.isin(FLIGHT, flights), 2.0 * WARN, 0.0))["evidence"][0]


def test_work_closes_component_alert():
    cases = alerts(2.0 * WARN, work_before(50, UNIT.code, UNIT.ended_by[0]))
    assert cases.select("raised_flight_id", "closed_at").rows() == [("F002", departure(50)), ("F052", None)]


def test_other_component_raises_nothing():
    others = component_rows(0.0).with_columns(component=pl.lit("OTHER"))
    assert raise_component_alerts(others, NOTHING, UNIT, Limits()).height == 0


def evidence_of(**facts: float) -> Evidence:
    return diagnosis_of(UNIT, Limits()).evidence(LossFacts(**facts), "F07")


@pytest.mark.parametrize(
    ("loss", "severity", "role"), [(0.79 * FAILS, "medium", "Neutral"), (0.81 * FAILS, "high", "Supports")]
)
def test_component_evidence_states_figures(loss, severity, role):
    facts = {"loss": loss, "loss_sd": 0.01, "loss_slope_30_per_flight": 0.0021, "loss_step_3": 0.101}
    evidence = evidence_of(**facts)
    assert diagnosis_of(UNIT, Limits()).severity(LossFacts(**facts)) == severity
    assert [w.role for w in evidence.corroborations] == [role, "Neutral"]
    for words in (
        f"{UNIT.lost} ({UNIT.loss}) {100 * loss:.0f} %", "2.1 points more every ten flights",
        f"{loss / 0.01:.0f} times its uncertainty; above {100 * WARN:.0f} % since F07",
        "10 points came within three flights", f"it fails at about {100 * FAILS:.0f} %",
    ):  # fmt: skip
        assert words in evidence.text()


@pytest.mark.parametrize("step", [0.1, float("nan")])
def test_steady_loss_states_no_points(step):
    calm = evidence_of(loss=0.3, loss_sd=0.0, loss_slope_30_per_flight=1e-5, loss_step_3=step)
    assert "points" not in calm.text()


def test_component_features_share_one_name():
    long = component_rows(0.0).select("operator", "tail", "flight_id", "pack", "departed_at").with_columns(
        component=pl.lit(UNIT.code), parameter=pl.lit(UNIT.loss), value=0.001 * pl.int_range(pl.len()), sd=pl.lit(0.01),
        status=pl.lit("ok"),
    )  # fmt: skip
    other = long.with_columns(component=pl.lit("HX"), value=pl.lit(9.0))
    schema = {
        "operator": pl.String, "tail": pl.String, "flight_id": pl.String, "pack": pl.Int32, "component": pl.String,
    }  # fmt: skip
    none = pl.DataFrame(schema=schema | {"signal": pl.String, "kind": pl.String, "mean": pl.Float64})
    rows = component_features(pl.concat([long, other]), none, long, NOTHING, UNIT)
    latest = rows.row(-1, named=True)
    assert rows["loss"].to_list() == pytest.approx((0.001 * FLIGHT).tolist())
    assert (latest["loss_slope_30_per_flight"], latest["loss_jump_10"]) == pytest.approx((0.001, 0.01))
    assert set(rows["component"]) == {UNIT.code}
