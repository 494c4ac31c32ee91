"""The missing-physics assistant: it proposes what was left out, nothing else, and accepting it mends the model."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from made import made_fleet

from hdt_core.physics.terms import TERMS, recorded
from hdt_core.twin import exchanger as hx
from hdt_core.twin.calibrate import calibrate
from hdt_core.twin.crossing import IN_ORDER, PACK
from hdt_core.twin.dsm import Dsm
from hdt_core.twin.flights import estimate_flights
from hdt_core.twin.missing import propose

SPRAY = 0.3


@pytest.fixture(scope="module")
def sprayed():
    """The fleet of `made` with water sprayed at the ram inlet: the exchanger meets cooler air than the probe reads."""
    fleet = made_fleet(4, 120)
    met = {name: fleet.samples[name].to_numpy() for name in hx.SIGNALS}
    tat_k = pl.Series("tat_k", recorded(met, {"water_spray": SPRAY})["tat_k"])
    return replace(fleet, samples=fleet.samples.with_columns(tat_k))


@pytest.fixture(scope="module")
def lacking(sprayed):
    return calibrate(sprayed.samples, sprayed.legs, sprayed.maintenance)


@pytest.fixture(scope="module")
def mended(sprayed):
    return calibrate(sprayed.samples, sprayed.legs, sprayed.maintenance, ("water_spray",))


def scatter(flights):
    change = flights.sort(IN_ORDER).select(pl.col("ln_ua_ratio").diff().over(PACK))["ln_ua_ratio"].drop_nulls()
    return float(np.std(change.to_numpy()))


def test_nothing_is_proposed_where_nothing_is_missing(fleet, model):
    found = propose(estimate_flights(fleet.samples, model), model)
    assert set(found["term"]) == set(TERMS)
    assert not found["proposed"].any()
    assert found["bic_gain"].max() < 0.0


def test_the_missing_term_is_proposed_and_only_it(sprayed, lacking):
    found = propose(estimate_flights(sprayed.samples, lacking), lacking)
    assert found.filter("proposed")["term"].to_list() == ["water_spray"]
    best = found.row(0, named=True)
    assert best["held_out_change"] < -0.3
    assert best["value"] == pytest.approx(SPRAY, abs=4.0 * best["sd"])


def test_accepting_it_mends_residual_and_coefficient(sprayed, lacking, mended):
    assert mended.terms["water_spray"] == pytest.approx(SPRAY, abs=0.06)
    before, after = (estimate_flights(sprayed.samples, model) for model in (lacking, mended))
    assert scatter(after) < 0.7 * scatter(before)
    assert not propose(after, mended)["proposed"].any()
    assert Dsm.from_dict(mended.to_dict()) == mended


def test_too_few_flights_say_so(sprayed, lacking):
    few = estimate_flights(sprayed.samples.head(40), lacking)
    found = propose(few, lacking)
    assert not found["proposed"].any()
    assert found["value"].null_count() == len(TERMS)
    assert propose(few.clear(), lacking)["n"].to_list() == [0] * len(TERMS)
