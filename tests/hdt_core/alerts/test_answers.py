"""What work since the night does to its alerts, by the rules of a night."""

import datetime as dt

import polars as pl
import pytest

from hdt_core.alerts.answers import alerts_now
from hdt_core.tables.alerts import FeaturesAlerts
from hdt_core.tables.raw import RawMaintenance

RAISED = dt.datetime(2024, 5, 1, 6, tzinfo=dt.UTC)
LATER = RAISED + dt.timedelta(days=5)
OWN = {"operator": "AAA", "tail": "T-1", "pack": 1}


def alerts(diagnosis: str, component: str, **more) -> pl.DataFrame:
    row = OWN | {"alert_id": "a", "diagnosis": diagnosis, "component": component, "raised_at": RAISED} | more
    return pl.DataFrame([row], schema=FeaturesAlerts.create_empty().schema)


def work(component: str, action: str, **more) -> pl.DataFrame:
    row = OWN | {"component": component, "action": action, "counts_from": LATER, "done_on": LATER.date()} | more
    return RawMaintenance.conform(pl.DataFrame([row]))


WASH = work("HX", "CLEANED")


def ending(alert: pl.DataFrame, entry: pl.DataFrame) -> tuple:
    """When and why the alert ends by an entry that the night did not have."""
    log = entry.with_columns(since_night=pl.lit(True))
    return alerts_now(alert, entry.clear(), log).select("closed_at", "closed_reason").row(0)


@pytest.mark.parametrize(
    ("diagnosis", "component", "action", "reason"),
    [
        ("HX_FOULING", "HX", "CLEANED", "renewed"),
        ("HX_LOW_MARGIN", "HX", "REPLACED", "renewed"),
        ("CC_DEGRADED", "CC", "CLEANED", None),
        ("CC_DEGRADED", "CC", "REPLACED", "renewed"),
        ("SENSOR_FAULT", "SENSOR", "ADJUSTED", "renewed"),
        ("HX_FOULING", "HX", "INSPECTED", None),
        ("CAC_DEGRADED", "CAC", "REPLACED", "renewed"),
    ],
)
def test_work_ends_alerts_of_its_part(diagnosis, component, action, reason):
    assert ending(alerts(diagnosis, component), work(component, action))[1] == reason


def test_alert_ends_when_work_counts():
    assert ending(alerts("HX_FOULING", "HX"), WASH)[0] == LATER


@pytest.mark.parametrize(
    "other", [{"pack": 2}, {"tail": "T-2"}, {"component": "CC"}, {"counts_from": RAISED - dt.timedelta(days=1)}]
)
def test_other_work_ends_nothing(other):
    assert ending(alerts("HX_FOULING", "HX"), WASH.with_columns(**values(other)))[1] is None


def values(columns: dict) -> dict:
    """The values as columns of the types of the maintenance log."""
    types = RawMaintenance.types()
    return {name: pl.lit(value).cast(types[name]) for name, value in columns.items()}


CLEAN = {"finding": "NO_FAULT_FOUND"}


@pytest.mark.parametrize(
    ("diagnosis", "closes", "reason"),
    [
        ("HX_FOULING", {}, "found_clean"),
        ("HX_LOW_MARGIN", {}, None),
        ("HX_LOW_MARGIN", {"closes_alert_id": "a"}, "found_clean"),
        ("HX_LOW_MARGIN", {"closes_diagnosis": "HX_LOW_MARGIN"}, "found_clean"),
        ("HX_LOW_MARGIN", {"closes_diagnosis": "HX_FOULING", "closes_alert_id": "b"}, None),
    ],
)
def test_clean_finding_closes_contradicted_alert(diagnosis, closes, reason):
    assert ending(alerts(diagnosis, "HX"), work("HX", "INSPECTED", **CLEAN, **closes))[1] == reason


def test_fault_finding_closes_nothing():
    assert ending(alerts("HX_FOULING", "HX"), work("HX", "INSPECTED", finding="FOULED"))[1] is None


def closing_without(withdrawn: pl.DataFrame, left: pl.DataFrame, at: dt.datetime, reason: str) -> tuple:
    """When and why an alert of fouling, closed so, ends once work that the night had is withdrawn."""
    closed = alerts("HX_FOULING", "HX", closed_at=at, closed_reason=reason)
    return alerts_now(closed, pl.concat([withdrawn, left]), left).select("closed_at", "closed_reason").row(0)


def test_withdrawn_closing_reopens_alert():
    assert closing_without(WASH, WASH.clear(), LATER, "renewed") == (None, None)


def test_recovered_alert_stays_closed():
    assert closing_without(WASH, WASH.clear(), LATER, "recovered") == (LATER, "recovered")


def test_withdrawn_closing_keeps_earlier_end():
    before = LATER - dt.timedelta(hours=1)
    assert closing_without(WASH, WASH.clear(), before, "renewed") == (before, "renewed")


def test_remaining_work_keeps_alert_closed():
    """The closing is withdrawn, the wash of the same day is not."""
    clean = work("HX", "INSPECTED", **CLEAN)
    assert closing_without(clean, WASH, LATER, "found_clean")[1] == "renewed"
