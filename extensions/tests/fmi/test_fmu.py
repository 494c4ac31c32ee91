"""An FMU as a component says what its equation, closed form and fmpy say; without inputs, with events or without."""

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
    declaration = {"inputs": INPUTS, "outputs": OUTPUTS, "params": (UA, HEAT, FOULING), "variables": NAMES}
    return fmu_model(fmu, **declaration, losses={"hc_fouling": "hc_ua_w_k"})


def rate_k_s(flow, hot_k, air_k, ua, heat, oil_k):
    return (flow * (hot_k - oil_k) - ua * (oil_k - air_k)) / heat


def test_rates_equal_those_of_source(tank):
    rng = np.random.default_rng(0)
    flow = rng.uniform(100, 400, (3, 1))
    hot = rng.uniform(310, 350, (1, 4))
    air = 295.0
    ua = rng.uniform(50, 300, (3, 4))
    oil = rng.uniform(295, 330, (3, 4))
    at = {"oil_flow_w_k": flow, "oil_in_k": hot, "air_in_k": air, "hc_ua_w_k": ua, "hc_fouling": 0.3, "oil_T": oil}
    expected = rate_k_s(flow, hot, air, 0.7 * ua, 40_000.0, oil)
    np.testing.assert_allclose(tank.rates(**at, heat=40_000.0)[0], expected, rtol=1e-12)
    np.testing.assert_array_equal(tank.equations(**at, heat=40_000.0)[0], oil)


def test_state_is_that_of_source(tank):
    assert [(state.name, state.unit, state.initial) for state in tank.states] == [("oil_T", "K", 300.0)]


def test_tank_relaxes_as_closed_form(tank):
    """From 300 K to the mean of both streams weighted by their conductances, with time constant heat / (flow + UA)."""
    n = 200
    dt_s = 2.0
    inputs = {"oil_flow_w_k": 250.0, "oil_in_k": np.full(n, 330.0), "air_in_k": 295.0}
    return_k = tank.simulate({"hc_fouling": 0.5}, inputs, dt_s)["return_k"]
    final = (250.0 * 330.0 + 85.0 * 295.0) / 335.0
    time_s = dt_s * np.arange(n)
    np.testing.assert_allclose(return_k, final + (300.0 - final) * np.exp(-time_s * 335.0 / 40_000.0), atol=1e-5)


def record(tank, loss, n=120):
    rng = np.random.default_rng(1)
    flow = 250.0 + 60.0 * np.sin(np.arange(n) / 9.0)
    inputs = {"oil_flow_w_k": flow, "oil_in_k": np.full(n, 330.0), "air_in_k": np.full(n, 295.0)}
    true = tank.simulate({"hc_fouling": loss}, inputs, 5.0)["return_k"]
    return inputs, {"return_k": true + 0.1 * rng.standard_normal(n)}


@pytest.mark.parametrize(
    "estimator", [NonlinearLeastSquares(), ExtendedKalman(), UnscentedKalman()], ids=lambda e: e.name
)
def test_estimators_recover_tank_loss(tank, estimator):
    inputs, measured = record(tank, 0.35)
    problem = declared_problem(tank, ["hc_fouling"], inputs, measured, prior=unknown(np.array([0.0])), dt_s=5.0)
    estimate = estimator.estimate(problem)
    assert estimate.status == "converged"
    assert abs(estimate.belief.mean[0] - 0.35) < 4.0 * estimate.belief.sd[0]
    assert estimate.belief.sd[0] < 0.02


def test_only_rejected_point_is_missing(tank):
    at = {"oil_flow_w_k": np.array([250.0, -1.0, np.nan, 250.0]), "oil_in_k": 330.0, "air_in_k": 295.0}
    return_k = tank.predict({}, at)["return_k"]
    np.testing.assert_array_equal(np.isnan(return_k), [False, True, True, False])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({}, r"oil_flow_w_k is no input; it has air_in_k, inlet\.T, inlet\.flow"),
        ({"outputs": (Signal("return_k", "degC"),), "variables": NAMES}, "return_k is in K, declared in degC"),
        ({"losses": {"hc_fouling": "hc_ua_w_k"}}, "losses name hc_fouling, declared as no parameter"),
    ],
    ids=["name", "unit", "kind"],
)
def test_wrong_declaration_is_refused(fmu, change, message):
    with pytest.raises(ValueError, match=message):
        fmu_model(fmu, **{"inputs": INPUTS, "outputs": OUTPUTS, "params": (UA,)} | change)


def test_run_over_time_takes_no_inputs(fmu):
    with pytest.raises(ValueError, match=r"has inputs \(air_in_k, inlet\.T, inlet\.flow\)"):
        fmu_over_time(fmu, outputs=OUTPUTS, params=(UA,), variables=NAMES)


def test_other_file_kinds_are_named(tmp_path, description, fmu):
    declaration = {"inputs": INPUTS, "outputs": OUTPUTS, "params": (UA, HEAT), "variables": NAMES}
    with pytest.raises(ValueError, match="no FMU"):
        fmu_model(SOURCE / "oil_tank.c", **declaration)
    with pytest.raises(ValueError, match="no binary for"):
        fmu_model(pack_fmu(tmp_path, "oil_tank", description), **declaration)
    hidden = description.replace("<ModelExchange", "<CoSimulation").replace(' numberOfEventIndicators="0"', "")
    with pytest.raises(ValueError, match=r"FMI 2.0, coSimulation; needs FMI 2.0, modelExchange"):
        fmu_model(pack_fmu(tmp_path, "oil_tank", hidden), **declaration)


def test_missing_fmpy_names_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "fmpy.fmi2", None)
    with pytest.raises(ImportError, match=r"pip install 'hybrid-digital-twin-extensions\[fmi\]'"):
        fmu_model("any.fmu", inputs=INPUTS, outputs=OUTPUTS, params=(UA,))


def test_how_to_runs(fmu, monkeypatch):
    monkeypatch.chdir(fmu.parent)
    assert walk("howto-component.md", "Physics from an FMU")["estimate"].status == "converged"


CONTINUOUS = {
    "van_der_pol": (1, ("x0", "x1"), Param("mu", "-", 1.0, (0.1, 5.0), "design")),
    "dahlquist": (2, ("x",), Param("k", "-", 1.0, (0.1, 5.0), "design")),
}
GRAVITY = Param("g", "-", -9.81, (-20.0, -1.0), "design")
BOUNCE = Param("e", "-", 0.7, (0.1, 0.95), "design")
SLOWEST = 0.1  # of free_models.c, below which the ball lies still


def describe(name: str, states: tuple[str, ...], constants: tuple[str, ...], indicators: int) -> str:
    start = {"van_der_pol": (2.0, 0.0, 1.0), "dahlquist": (1.0, 1.0)}.get(name, (1.0, 0.0, -9.81, 0.7))
    variables = []
    row = '<ScalarVariable name="{}" valueReference="{}" {}><Real {}/></ScalarVariable>'
    for i, state in enumerate(states):
        variables.append(row.format(state, i, 'causality="output" initial="exact"', f'start="{start[i]}"'))
    for i, state in enumerate(states):
        variables.append(row.format(f"der({state})", 2 + i, "", f'derivative="{i + 1}"'))
    for i, constant in enumerate(constants):
        kind = 'causality="parameter" variability="fixed"'
        variables.append(row.format(constant, 4 + i, kind, f'start="{start[len(states) + i]}"'))
    if not states:
        whole = row.replace("Real", "Integer")
        variables.append(whole.format("count", 0, 'causality="output" variability="discrete"', ""))
    n = len(states)
    outputs = "".join(f'<Unknown index="{i + 1}"/>' for i in range(max(n, 1)))
    rates = "".join(f'<Unknown index="{n + i + 1}"/>' for i in range(n))
    structure = f"<Outputs>{outputs}</Outputs>" + (f"<Derivatives>{rates}</Derivatives>" if n else "")
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription fmiVersion="2.0" modelName="{name}" guid="{name}" '
        f'numberOfEventIndicators="{indicators}"><ModelExchange modelIdentifier="{name}"/>'
        f"<ModelVariables>{''.join(variables)}</ModelVariables><ModelStructure>{structure}</ModelStructure>"
        "</fmiModelDescription>"
    )


def built(folder: Path, name: str, number: int, text: str) -> Path:
    return build_fmu(folder, name, SOURCE / "free_models.c", text, f"-DMODEL={number}")


def loaded(folder: Path, name: str):
    number, states, constant = CONTINUOUS[name]
    path = built(folder, name, number, describe(name, states, (constant.name,), 0))
    outputs = tuple(Signal(state, "-", sigma=0.01) for state in states)
    return path, fmu_model(path, inputs=(), outputs=outputs, params=(constant,))


@pytest.mark.parametrize("name", CONTINUOUS)
def test_free_run_equals_fmpy(tmp_path, name):
    path, model = loaded(tmp_path, name)
    ours = model.simulate({}, {}, 0.01, n_samples=1001)
    theirs = theirs_of(path, 10.0, 0.01)
    for output in model.outputs:
        np.testing.assert_allclose(ours[output.name], theirs[output.name][:1001], atol=2e-5)


def test_free_parameter_is_estimated(tmp_path):
    _, model = loaded(tmp_path, "van_der_pol")
    outputs = {k: v[:120] for k, v in model.simulate({"mu": 1.5}, {}, 0.05, n_samples=120).items()}
    rng = np.random.default_rng(0)
    measured = {name: values + 0.01 * rng.standard_normal(120) for name, values in outputs.items()}
    problem = declared_problem(model, ["mu"], {}, measured, prior=unknown(np.array([1.0])), dt_s=0.05)
    estimate = NonlinearLeastSquares().estimate(problem)
    assert estimate.status == "converged"
    assert abs(estimate.belief.mean[0] - 1.5) < 4.0 * estimate.belief.sd[0]


@pytest.fixture(scope="module")
def ball_fmu(tmp_path_factory):
    return built(tmp_path_factory.mktemp("ball"), "ball", 3, describe("ball", ("h", "v"), ("g", "e"), 1))


@pytest.fixture(scope="module")
def ball(ball_fmu):
    return fmu_over_time(ball_fmu, outputs=(Signal("h", "-", 0.01), Signal("v", "-")), params=(GRAVITY, BOUNCE))


@pytest.fixture(scope="module")
def stairs_fmu(tmp_path_factory):
    return built(tmp_path_factory.mktemp("stairs"), "stairs", 4, describe("stairs", (), (), 0))


def theirs_of(path, end_s, dt_s):
    import fmpy

    options = {"relative_tolerance": 1e-9, "fmi_type": "ModelExchange", "record_events": False}
    return fmpy.simulate_fmu(str(path), stop_time=end_s, output_interval=dt_s, **options)


def bounced(time_s: np.ndarray, g: float, e: float) -> np.ndarray:
    """Height of the ball, let fall from 1: parabola after parabola, the first of them half a one."""
    start_s = 0.0
    speed = 0.0
    height = np.zeros(len(time_s))
    fall_s = np.sqrt(2.0 / g)
    lasting_s = fall_s
    while True:
        on = (time_s >= start_s) & (time_s <= start_s + lasting_s)
        since = time_s[on] - start_s
        height[on] = (1.0 if speed == 0.0 else 0.0) + speed * since - 0.5 * g * since**2
        start_s += lasting_s
        speed = e * (speed or g * fall_s)
        if speed < SLOWEST:
            return height
        lasting_s = 2.0 * speed / g


def test_ball_bounces_as_closed_form(ball):
    time_s = 0.01 * np.arange(401)
    height = ball.predict({}, {"time_s": time_s})["h"]
    np.testing.assert_allclose(height, bounced(time_s, 9.81, 0.7), atol=1e-6)
    assert height[-1] == pytest.approx(0.0, abs=1e-9)  # lies still: a memory that is none of its states


def test_ball_bounces_as_in_fmpy(ball_fmu, ball):
    ours = ball.predict({}, {"time_s": 0.01 * np.arange(401)})
    theirs = theirs_of(ball_fmu, 4.0, 0.01)
    np.testing.assert_allclose(ours["h"], theirs["h"], atol=1e-6)
    np.testing.assert_allclose(ours["v"], theirs["v"], atol=1e-5)


def test_stairs_climb_by_clock(stairs_fmu):
    stairs = fmu_over_time(stairs_fmu, outputs=(Signal("count", "-"),), params=())
    time_s = 0.25 * np.arange(45)
    ours = stairs.predict({}, {"time_s": time_s})["count"]
    np.testing.assert_array_equal(ours, np.where(time_s < 9.0, 1.0 + np.floor(time_s), np.nan))
    theirs = theirs_of(stairs_fmu, 8.75, 0.25)
    np.testing.assert_array_equal(ours[:36], theirs["count"])


@pytest.mark.parametrize("name", CONTINUOUS)
def test_run_over_time_equals_states(tmp_path, name):
    path, model = loaded(tmp_path, name)
    over_time = fmu_over_time(path, outputs=model.outputs, params=model.params)
    constant = model.params[0].name
    expected = model.simulate({constant: 1.7}, {}, 0.05, n_samples=101)
    ours = over_time.predict({constant: 1.7}, {"time_s": 0.05 * np.arange(101)})
    for output in model.outputs:
        np.testing.assert_allclose(ours[output.name], expected[output.name], atol=2e-5)


def test_instants_come_in_any_order(ball):
    time_s = np.array([1.3, 0.2, np.nan, -1.0, 0.2])
    e = np.array([[0.7], [0.5]])
    heights = ball.predict({"e": e}, {"time_s": time_s})["h"]
    expected = [[bounced(np.array([t]), 9.81, x)[0] if t > 0.0 else np.nan for t in time_s] for x in (0.7, 0.5)]
    np.testing.assert_allclose(heights, expected, atol=1e-6)


def test_ball_parameters_are_estimated(ball):
    time_s = 0.02 * np.arange(150)
    rng = np.random.default_rng(0)
    measured = {"h": bounced(time_s, 9.5, 0.65) + 0.01 * rng.standard_normal(150)}
    problem = declared_problem(ball, ["g", "e"], {"time_s": time_s}, measured, prior=unknown(np.array([-9.81, 0.7])))
    estimate = NonlinearLeastSquares().estimate(problem)
    assert estimate.status == "converged"
    np.testing.assert_array_less(np.abs(estimate.belief.mean - [-9.5, 0.65]), 4.0 * estimate.belief.sd)
    assert estimate.belief.sd[1] < 0.005


def test_events_need_run_over_time(ball_fmu, stairs_fmu):
    with pytest.raises(ValueError, match="1 event indicators; declare a model with events by fmu_over_time"):
        fmu_model(ball_fmu, inputs=(), outputs=(Signal("h", "-"),), params=())
    with pytest.raises(ValueError, match="event at 1 s; declare a model with events by fmu_over_time"):
        fmu_model(stairs_fmu, inputs=(), outputs=(), params=())
