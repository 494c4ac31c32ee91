"""The facts that a case's evidence rests on."""

import math

import pytest

from hdt_core.alerts.diagnoses.compressor import CompressorFacts
from hdt_core.alerts.diagnoses.ram_door import DoorFacts

LATEST = {"cc_efficiency_loss": 0.1}


def latest(name: str) -> float:
    return LATEST.get(name, math.nan)


def test_facts_join_features_with_case():
    facts = CompressorFacts.collect({"since": 3, "shrunk": -0.02, "follows": None}, latest)

    assert (facts.cc_efficiency_loss, facts.shrunk) == (0.1, -0.02)


def test_unrecorded_feature_is_nan():
    assert math.isnan(CompressorFacts.collect({}, latest).cc_diameter_loss)


@pytest.mark.parametrize("own", [{"kind": "jam", "stop": 0.4}, {"kind": "jam", "stop": 0.4, "exces_k": 0.0}])
def test_undeclared_fact_is_an_error(own):
    with pytest.raises(TypeError, match=r"excess?_k"):
        DoorFacts.collect(own, latest)
