"""A diagnosis of somebody's own: one declaration, whose rule finds its cases."""

from dataclasses import dataclass

import numpy as np
import pytest
from one_pack import features
from twin_flights import NO_LOG

from hdt_core.alerts import alerts
from hdt_core.alerts.cases import Case, Grid, Limits
from hdt_core.alerts.diagnoses import DIAGNOSES
from hdt_core.alerts.diagnosis import Diagnosis
from hdt_core.alerts.disturbances import Disturbances
from hdt_core.alerts.evidence import Evidence
from hdt_core.alerts.facts import Facts
from hdt_core.alerts.phrases import ABOVE
from hdt_core.alerts.text import Text


@dataclass(frozen=True, slots=True, kw_only=True)
class WaterFacts(Facts):
    """Of a pack with water."""

    litres: float


def find_water(grid: Grid, maintenance: object, limits: Limits, disturbances: Disturbances) -> list[Case]:
    return [Case(0, "HX", "HX_WATER", 5, None, {"since": 3, "litres": 2.0})]


WATER = Diagnosis(
    code="HX_WATER",
    component="HX",
    name="water in the duct",
    action="Drain it",
    ended_by=("CLEANED",),
    record=WaterFacts,
    severity=lambda facts: "high" if facts.litres > 1.0 else "low",
    evidence=lambda facts, since: Evidence((Text(ABOVE, value=since),), (), "rain", "Waiting costs ice"),
    rule=find_water,
)


@pytest.fixture
def raised(monkeypatch: pytest.MonkeyPatch) -> dict:
    """The alert of a sound pack that the rule calls wet."""
    monkeypatch.setitem(DIAGNOSES, WATER.code, WATER)
    return alerts.raise_alerts(features(np.zeros(60)), NO_LOG).row(0, named=True)


def test_own_rule_raises_alert(raised):
    assert (raised["diagnosis"], raised["severity"], raised["recommended_action"]) == ("HX_WATER", "high", "Drain it")


def test_own_phrase_is_stored(raised):
    assert ABOVE in raised["evidence_phrases"]


def test_every_shipped_diagnosis_is_collected():
    assert set(DIAGNOSES) == {
        "CC_DEGRADED", "HX_FOULING", "HX_LOW_MARGIN", "HX_SUDDEN_CLOG", "RAM_DOOR_FAULT", "SENSOR_FAULT",
    }  # fmt: skip
