"""An FMU as a component: its own C source says the same as the equation, and every estimator takes it."""

import sys
from pathlib import Path

import numpy as np
import pytest
from fmus import build_fmu, pack_fmu
from pages import walk

from hdt_core.estimation import ExtendedKalman, NonlinearLeastSquares, UnscentedKalman, unknown
from hdt_core.estimation.declared import declared_problem
from hdt_core.physics.model import Param, Signal
from hdt_fmi.fmu import fmu_model
from hdt_fmi.fmu_events import fmu_over_time

SOURCE = Path(__file__).with_name("data")
INPUTS = (Signal("oil_flow_w_k", "W/K"), Signal("oil_in_k", "K"), Signal("air_in_k", "K"))
OUTPUTS = (Signal("return_k", "K", sigma=0.1),)
UA = Param("hc_ua_w_k", "W/K", 170.0, (20.0, 600.0), "design")
HEAT = Param("heat", "J/K", 40_000.0, (1e4, 1e5), "design")
FOULING = Param("hc_fouling", "-", 0.0, (-0.25, 0.95), "health", drift=0.01)
NAMES = {"oil_flow_w_k": "inlet.flow", "oil_in_k": "inlet.T", "hc_ua_w_k": "ua"}


@pytest.fixture(scope="module")
def description() -> str:
    return (SOURCE / "modelDescription.xml").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def fmu(tmp_path_factory, description) -> Path:
    return build_fmu(tmp_path_factory.mktemp("fmu"), "oil_tank", SOURCE / "oil_tank.c", description)


@pytest.fixture(scope="module")
def tank(fmu):
    return fmu_model(
        fmu,
        inputs=INPUTS,
        outputs=OUTPUTS,
        params=(UA, HEAT, FOULING),
        variables=NAMES,
        losses={"hc_fouling": "hc_ua_w_k"},
    )


def rate_k_s(flow, hot_k, air_k, ua, heat, oil_k):
    return (flow * (hot_k - oil_k) - ua * (oil_k - air_k)) / heat


def test_rates_and_outputs_are_those_of_its_source(tank):
    rng = np.random.default_rng(0)
    flow, hot, air = rng.uniform(100, 400, (3, 1)), rng.uniform(310, 350, (1, 4)), 295.0
    ua, loss, oil = rng.uniform(50, 300, (3, 4)), 0.3, rng.uniform(295, 330, (3, 4))
    at = {"oil_flow_w_k": flow, "oil_in_k": hot, "air_in_k": air, "hc_ua_w_k": ua, "hc_fouling": loss, "oil_T": oil}
    expected = rate_k_s(flow, hot, air, 0.7 * ua, 40_000.0, oil)
    np.testing.assert_allclose(tank.rates(**at, heat=40_000.0)[0], expected, rtol=1e-12)
    np.testing.assert_array_equal(tank.equations(**at, heat=40_000.0)[0], oil)


def test_states_are_the_fmus_own(tank):
    (state,) = tank.states
    assert (state.name, state.unit, state.initial) == ("oil_T", "K", 300.0)


def test_it_relaxes_as_the_closed_form_does(tank):
    """From 300 K to the mean of both streams weighted by their conductances, with time constant heat / (flow + UA)."""
    n, dt_s = 200, 2.0
    inputs = {"oil_flow_w_k": 250.0, "oil_in_k": np.full(n, 330.0), "air_in_k": 295.0}
    return_k = tank.simulate({"hc_fouling": 0.5}, inputs, dt_s)["return_k"]
    final = (250.0 * 330.0 + 85.0 * 295.0) / 335.0
    time_s = dt_s * np.arange(n)
    np.testing.assert_allclose(return_k, final + (300.0 - final) * np.exp(-time_s * 335.0 / 40_000.0), atol=1e-5)


def record(tank, loss, n=120):
    rng = np.random.default_rng(1)
    inputs = {
        "oil_flow_w_k": 250.0 + 60.0 * np.sin(np.arange(n) / 9.0),
        "oil_in_k": np.full(n, 330.0),
        "air_in_k": np.full(n, 295.0),
    }
    true = tank.simulate({"hc_fouling": loss}, inputs, 5.0)["return_k"]
    return inputs, {"return_k": true + 0.1 * rng.standard_normal(n)}


@pytest.mark.parametrize(
    "estimator", [NonlinearLeastSquares(), ExtendedKalman(), UnscentedKalman()], ids=lambda e: e.name
)
def test_estimators_recover_its_loss(tank, estimator):
    inputs, measured = record(tank, 0.35)
    problem = declared_problem(tank, ["hc_fouling"], inputs, measured, prior=unknown(np.array([0.0])), dt_s=5.0)
    estimate = estimator.estimate(problem)
    assert estimate.status == "converged"
    assert abs(estimate.belief.mean[0] - 0.35) < 4.0 * estimate.belief.sd[0]
    assert estimate.belief.sd[0] < 0.02


def test_a_point_that_it_rejects_is_missing_and_the_next_is_not(tank):
    at = {"oil_flow_w_k": np.array([250.0, -1.0, np.nan, 250.0]), "oil_in_k": 330.0, "air_in_k": 295.0}
    return_k = tank.predict({}, at)["return_k"]
    np.testing.assert_array_equal(np.isnan(return_k), [False, True, True, False])


def test_names_kinds_and_units_are_checked(fmu):
    with pytest.raises(ValueError, match=r"oil_flow_w_k is no input; it has air_in_k, inlet\.T, inlet\.flow"):
        fmu_model(fmu, inputs=INPUTS, outputs=OUTPUTS, params=(UA,))
    with pytest.raises(ValueError, match="return_k is in K, declared in degC"):
        fmu_model(fmu, inputs=INPUTS, outputs=(Signal("return_k", "degC"),), params=(UA,), variables=NAMES)
    with pytest.raises(ValueError, match="losses name hc_fouling, declared as no parameter"):
        fmu_model(fmu, inputs=INPUTS, outputs=OUTPUTS, params=(UA,), losses={"hc_fouling": "hc_ua_w_k"})


def test_other_kinds_of_file_are_named(tmp_path, description, fmu):
    declaration = {"inputs": INPUTS, "outputs": OUTPUTS, "params": (UA, HEAT), "variables": NAMES}
    with pytest.raises(ValueError, match="no FMU"):
        fmu_model(SOURCE / "oil_tank.c", **declaration)
    with pytest.raises(ValueError, match="no binary for"):
        fmu_model(pack_fmu(tmp_path, "oil_tank", description), **declaration)
    hidden = description.replace("<ModelExchange", "<CoSimulation").replace(' numberOfEventIndicators="0"', "")
    with pytest.raises(ValueError, match=r"FMI 2.0, coSimulation; needs FMI 2.0, modelExchange"):
        fmu_model(pack_fmu(tmp_path, "oil_tank", hidden), **declaration)


def test_a_run_over_time_takes_no_inputs(fmu):
    with pytest.raises(ValueError, match=r"has inputs \(air_in_k, inlet\.T, inlet\.flow\)"):
        fmu_over_time(fmu, outputs=OUTPUTS, params=(UA,), variables=NAMES)


def test_without_the_extra_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "fmpy.fmi2", None)
    with pytest.raises(ImportError, match=r"pip install 'hybrid-digital-twin-extensions\[fmi\]'"):
        fmu_model("any.fmu", inputs=INPUTS, outputs=OUTPUTS, params=(UA,))


def test_the_how_to_runs(fmu, monkeypatch):
    monkeypatch.chdir(fmu.parent)
    assert walk("howto-component.md", "Physics from an FMU")["estimate"].status == "converged"
