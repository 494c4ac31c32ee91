"""The missing-physics assistant: it proposes what was left out, nothing else, and accepting it mends the model."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from made import made_fleet

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.dsm import Dsm
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.calibration.missing_physics import propose
from hdt_core.physics.terms import TERMS, record_signals
from hdt_core.records.keys import IN_ORDER, PACK

SPRAY = 0.3


def lacking_term(fleet, name, value):
    """The fleet as its sensors record it where the exchanger meets what the term says."""
    met, signal = {name: fleet.samples[name].to_numpy() for name in hx.SIGNALS}, TERMS[name].signal
    seen = pl.Series(signal, record_signals(met, {name: value})[signal])
    return replace(fleet, samples=fleet.samples.with_columns(seen))


@pytest.fixture(scope="module")
def plain():
    return made_fleet(4, 120)


@pytest.fixture(scope="module")
def sprayed(plain):
    """Water sprayed at the ram inlet: the exchanger meets cooler air than the probe reads."""
    return lacking_term(plain, "water_spray", SPRAY)


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


@pytest.mark.parametrize(("name", "value"), [("water_spray", SPRAY), ("flow_leak", 0.2)])
def test_on_an_aircraft_never_seen_the_accepted_term_leaves_noise_alone(plain, name, value):
    """Aircraft 3 is left out of every calibration; where nothing is missing, its residual is what no model explains."""
    learned, other = ("T-00", "T-01", "T-02"), "T-03"
    fleet = lacking_term(plain, name, value)
    taught = fleet.only(*learned)
    found = calibrate(taught.samples, taught.legs, taught.maintenance, (name,))
    assert found.terms[name] == pytest.approx(value, rel=0.3)
    noise_model = calibrate(plain.only(*learned).samples, taught.legs, taught.maintenance)
    noise = scatter(estimate_flights(plain.only(other).samples, noise_model))
    before, after = (
        scatter(estimate_flights(fleet.only(other).samples, model))
        for model in (calibrate(taught.samples, taught.legs, taught.maintenance), found)
    )
    assert after < 0.7 * before
    assert after < 1.1 * noise


def test_worn_packs_speak_too(sprayed, lacking):
    """Wear moves slowly: the left packs, half of their conductance gone, tell as much of the weather's doing."""
    worn = estimate_flights(sprayed.samples, lacking).filter(pack=1)
    assert propose(worn, lacking).filter("proposed")["term"].to_list() == ["water_spray"]


def test_too_few_flights_say_so(sprayed, lacking):
    few = estimate_flights(sprayed.samples.head(40), lacking)
    found = propose(few, lacking)
    assert not found["proposed"].any()
    assert found["value"].null_count() == len(TERMS)
    assert propose(few.clear(), lacking)["n"].to_list() == [0] * len(TERMS)
