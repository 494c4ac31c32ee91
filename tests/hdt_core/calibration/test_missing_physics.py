"""The missing-physics assistant: it proposes what was left out, nothing else, and accepting it mends the model."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
from by_hand import DSM
from by_hand import flights as days
from known_fleet import fleet_with_truth

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.dsm import Dsm
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.calibration.missing_physics import coefficients, propose
from hdt_core.physics.air import standard_pressure_pa, total_to_static_pressure
from hdt_core.physics.heat_exchanger import outlets_k
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s, ln_clean_conductance
from hdt_core.physics.terms import TERMS, record_signals
from hdt_core.records.keys import IN_ORDER, PACK

SPRAY = 0.3


def lacking_term(fleet, name, value):
    """The fleet as its sensors record it where the exchanger meets what the term says."""
    truth = {name: fleet.samples[name].to_numpy() for name in hx.SIGNALS}
    signal = TERMS[name].signal
    readings = pl.Series(signal, record_signals(truth, {name: value})[signal])
    return replace(fleet, samples=fleet.samples.with_columns(readings))


@pytest.fixture(scope="module")
def plain_fleet():
    return fleet_with_truth(4, 120)


@pytest.fixture(scope="module")
def sprayed_fleet(plain_fleet):
    """Water sprayed at the ram inlet: the exchanger meets cooler air than the probe reads."""
    return lacking_term(plain_fleet, "water_spray", SPRAY)


@pytest.fixture(scope="module")
def incomplete_model(sprayed_fleet):
    return calibrate(sprayed_fleet.samples, sprayed_fleet.legs, sprayed_fleet.maintenance)


@pytest.fixture(scope="module")
def complete_model(sprayed_fleet):
    return calibrate(sprayed_fleet.samples, sprayed_fleet.legs, sprayed_fleet.maintenance, ("water_spray",))


def scatter(flights):
    change = flights.sort(IN_ORDER).select(pl.col("ln_ua_ratio").diff().over(PACK))["ln_ua_ratio"].drop_nulls()
    return float(np.std(change.to_numpy()))


def test_complete_model_gets_no_proposal(fleet, model):
    proposals = propose(estimate_flights(fleet.samples, model), model)
    assert set(proposals["term"]) == set(TERMS)
    assert not proposals["proposed"].any()
    assert proposals["bic_gain"].max() < 0.0


def test_missing_term_is_proposed_alone(sprayed_fleet, incomplete_model):
    proposals = propose(estimate_flights(sprayed_fleet.samples, incomplete_model), incomplete_model)
    assert proposals.filter("proposed")["term"].to_list() == ["water_spray"]
    best = proposals.row(0, named=True)
    assert best["held_out_change"] < -0.3
    assert best["value"] == pytest.approx(SPRAY, abs=4.0 * best["sd"])


def test_accepted_term_mends_model(sprayed_fleet, incomplete_model, complete_model):
    assert complete_model.terms["water_spray"] == pytest.approx(SPRAY, abs=0.06)
    before, after = (estimate_flights(sprayed_fleet.samples, model) for model in (incomplete_model, complete_model))
    assert scatter(after) < 0.7 * scatter(before)
    assert not propose(after, complete_model)["proposed"].any()


def test_mended_model_survives_dict(complete_model):
    assert Dsm.from_dict(complete_model.to_dict()) == complete_model


@pytest.mark.parametrize(("name", "value"), [("water_spray", SPRAY), ("flow_leak", 0.2)])
def test_term_explains_unseen_aircraft(plain_fleet, name, value):
    """Aircraft 3 is left out of every calibration; where nothing is missing, its residual is what no model explains."""
    fleet = lacking_term(plain_fleet, name, value)
    taught = fleet.only("T-00", "T-01", "T-02")
    refitted = calibrate(taught.samples, taught.legs, taught.maintenance, (name,))
    assert refitted.terms[name] == pytest.approx(value, rel=0.3)
    noise_model = calibrate(plain_fleet.only("T-00", "T-01", "T-02").samples, taught.legs, taught.maintenance)
    noise = scatter(estimate_flights(plain_fleet.only("T-03").samples, noise_model))
    plain_fit = calibrate(taught.samples, taught.legs, taught.maintenance)
    before, after = (scatter(estimate_flights(fleet.only("T-03").samples, m)) for m in (plain_fit, refitted))
    assert after < 0.7 * before
    assert after < 1.1 * noise


def test_worn_packs_propose_same_term(sprayed_fleet, incomplete_model):
    """Wear moves slowly: the left packs, half of their conductance gone, tell as much of the weather's doing."""
    worn = estimate_flights(sprayed_fleet.samples, incomplete_model).filter(pack=1)
    assert propose(worn, incomplete_model).filter("proposed")["term"].to_list() == ["water_spray"]


@pytest.mark.parametrize(("flights", "value"), [(60, 0.0), (61, SPRAY)])
def test_coefficient_needs_sixty_changes(flights, value):
    """A core of the model's own conductance in air that spray has cooled; by medians alone."""
    rng = np.random.default_rng(2)
    ranges = {
        "altitude_m": (10e3, 12e3), "mach": (0.78, 0.86), "tat_k": (238.0, 262.0), "hx_in_k": (380.0, 420.0),
        "ram_door_open": (0.2, 0.6), "pack_flow_kg_s": (0.6, 0.9),
    }  # fmt: skip
    truth = {name: rng.uniform(*limits, flights) for name, limits in ranges.items()}
    truth["total_pressure_pa"] = standard_pressure_pa(truth["altitude_m"]) * total_to_static_pressure(truth["mach"])
    ram = clean_ram_flow_kg_s(truth, DSM.design)
    ua = np.exp(ln_clean_conductance(truth, ram, DSM.design))
    truth["hx_out_k"] = outlets_k(truth["pack_flow_kg_s"], ram, truth["hx_in_k"], truth["tat_k"], ua)[0]
    readings = record_signals(truth, {"water_spray": SPRAY})
    ratio = hx.ln_conductance_ratio(readings, DSM.design, np.zeros((len(hx.BIASES), flights)))
    twin = days(flights, **{name: list(v) for name, v in readings.items()}, ram_out_k=330.0, ln_ua_ratio=list(ratio))
    assert coefficients(twin, DSM, ("water_spray",))["water_spray"] == pytest.approx(value, abs=0.01)


def test_accepted_coefficient_takes_three_rounds(monkeypatch):
    monkeypatch.setattr("hdt_core.calibration.calibrate._calibrate", lambda *args: SimpleNamespace(terms=args[-1]))
    for name in ("estimate_flights", "baseline_samples"):
        monkeypatch.setattr(f"hdt_core.calibration.calibrate.{name}", lambda *_: None)
    monkeypatch.setattr("hdt_core.calibration.calibrate.coefficients", lambda *_: {"water_spray": 0.1})
    assert calibrate(None, None, None, ("water_spray",)).terms["water_spray"] == pytest.approx(0.3)
    assert calibrate(None, None, None).terms == {}


def test_few_flights_propose_nothing(sprayed_fleet, incomplete_model):
    few = estimate_flights(sprayed_fleet.samples.head(40), incomplete_model)
    proposals = propose(few, incomplete_model)
    assert not proposals["proposed"].any()
    assert proposals["value"].null_count() == len(TERMS)
    assert propose(few.clear(), incomplete_model)["n"].to_list() == [0] * len(TERMS)
