"""States along a whole record: against SciPy at far tighter tolerances, and against transitions sample by sample."""

from importlib.util import find_spec

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hdt_core.estimation import NonlinearLeastSquares, PhysicsInformedNet, unknown
from hdt_core.estimation.declared import declared_problem
from hdt_core.physics.lumped_exchanger import rates_k_s
from hdt_core.physics.model import Param, PhysicsModel, Signal, State

DT_S = 0.1
N_SAMPLES = 120
FORMS = [False, pytest.param(True, marks=pytest.mark.skipif(find_spec("numba") is None, reason="needs numba"))]
EACH_FORM = pytest.mark.parametrize("compiled", FORMS, ids=["numpy", "numba"])


def van_der_pol_rates(*, mu, position, speed):
    return speed, mu * (1.0 - position**2) * speed - position


def with_others(*, speed, **others):
    """The same in a form that numba does not take."""
    return van_der_pol_rates(speed=speed, **others)


def oscillator(rates=van_der_pol_rates, *, compiled=False):
    model = PhysicsModel(
        name="van_der_pol",
        inputs=(),
        outputs=(Signal("seen", "-", sigma=0.05),),
        params=(Param("mu", "-", 1.0, (0.1, 5000.0), "design"),),
        equations=lambda mu, position, speed: position,
        states=(State("position", "-", 2.0), State("speed", "-", 0.0)),
        rates=rates,
    )
    noise = 0.05 * np.random.default_rng(0).standard_normal(N_SAMPLES)
    record = {"seen": TRUTH[0] + noise}
    return declared_problem(model, ["mu"], {}, record, dt_s=DT_S, prior=unknown(np.ones(1)), compiled=compiled)


def exact(mu):
    solution = solve_ivp(
        lambda _t, x: van_der_pol_rates(mu=mu, position=x[0], speed=x[1]),
        (0.0, DT_S * (N_SAMPLES - 1)),
        [2.0, 0.0],
        method="DOP853",
        t_eval=DT_S * np.arange(N_SAMPLES),
        rtol=1e-12,
        atol=1e-13,
    )
    return solution.y


TRUTH = exact(1.7)


def exchanger(*, compiled):
    """Equations (7) and (8) behind flows and temperatures that change at some samples, and rest between."""
    rng = np.random.default_rng(1)
    low_high = {
        "hot_flow_kg_s": (0.5, 1.2),
        "ram_flow_kg_s": (0.6, 2.4),
        "hot_in_k": (370, 430),
        "cold_in_k": (225, 280),
    }
    inputs = {name: np.repeat(rng.uniform(*ends, N_SAMPLES // 5), 5) for name, ends in low_high.items()}
    heat = [Param(f"hx_h_{side}_w_k", "W/K", 2500.0, (100.0, 1e5), "design") for side in ("hot", "cold")]
    mass = [Param(f"hx_mass_{side}_kg", "kg", 8.0, (0.1, 50.0), "design") for side in ("hot", "cold")]
    model = PhysicsModel(
        name="exchanger",
        inputs=tuple(Signal(name, "") for name in inputs),
        outputs=(Signal("hot_out_k", "K", sigma=0.5),),
        params=(*heat, *mass),
        equations=lambda hot_volume_k, **_: hot_volume_k,
        states=(State("hot_volume_k", "K", 320.0), State("cold_volume_k", "K", 290.0)),
        rates=rates_k_s,
    )
    record = {"hot_out_k": np.full(N_SAMPLES, 320.0)}
    return declared_problem(model, [p.name for p in heat], inputs, record, dt_s=1.0, compiled=compiled)


def by_transitions(problem, theta):
    """States (k, s) of one parameter set, by the model's own integrator from each sample to the next."""
    by_sample = problem.trajectory.__self__.by_sample
    states = [problem.start.mean]
    for i in range(N_SAMPLES - 1):
        states.append(by_sample(states[-1], theta, i))
    return np.array(states)


@EACH_FORM
def test_samples_between_steps_are_exact(compiled):
    states = oscillator(compiled=compiled).trajectory(np.array([[0.5, 1.7]]), N_SAMPLES)

    np.testing.assert_allclose(states[:, :, 1].T, TRUTH, atol=1e-6)


@EACH_FORM
def test_inputs_hold_between_changes(compiled):
    problem = exchanger(compiled=compiled)
    theta = np.array([1500.0, 3000.0])

    states = problem.trajectory(theta[:, None], N_SAMPLES)

    np.testing.assert_allclose(states[:, :, 0], by_transitions(problem, theta), atol=1e-5)


@EACH_FORM
def test_batched_transition_equals_single(compiled):
    problem = exchanger(compiled=compiled)
    theta = np.array([1500.0, 3000.0])
    x = np.array([350.0, 280.0])
    samples = np.array([0, 7, 40])

    together = problem.transition(x[:, None], theta[:, None], samples)

    alone = np.column_stack([problem.transition(x, theta, i) for i in samples])
    np.testing.assert_allclose(together, alone, rtol=1e-8)


@EACH_FORM
def test_stiff_column_leaves_others_alone(compiled):
    problem = oscillator(compiled=compiled)

    states = problem.trajectory(np.array([[1.7, 4000.0]]), N_SAMPLES)

    np.testing.assert_allclose(states[:, 0, 0], TRUTH[0], atol=1e-6)
    np.testing.assert_allclose(states[:, 0, 1], exact(4000.0)[0], atol=1e-6)


@EACH_FORM
def test_failed_column_is_nan_alone(compiled):
    states = oscillator(compiled=compiled).trajectory(np.array([[1.7, np.nan]]), N_SAMPLES)

    assert np.isnan(states[-1, :, 1]).all()
    np.testing.assert_allclose(states[:, 0, 0], TRUTH[0], atol=1e-6)


@EACH_FORM
def test_least_squares_recovers_damping(compiled):
    estimate = NonlinearLeastSquares().estimate(oscillator(compiled=compiled))

    assert estimate.status == "converged"
    assert abs(estimate.belief.mean[0] - 1.7) < 4.0 * estimate.belief.sd[0]


def test_net_converges_on_relaxing_oscillator():
    problem = oscillator()

    estimate = PhysicsInformedNet().estimate(problem)

    assert estimate.status == "converged"
    assert abs(estimate.belief.mean[0] - 1.7) < 4.0 * estimate.belief.sd[0]


@EACH_FORM
def test_uncompiled_rates_are_integrated(compiled):
    states = oscillator(with_others, compiled=compiled).trajectory(np.array([[1.7]]), N_SAMPLES)

    np.testing.assert_allclose(states[:, 0, 0], TRUTH[0], atol=1e-6)


def test_linearised_equals_separate_derivatives():
    problem = oscillator()
    theta = np.array([1.4])

    residual, slope = problem.linearised(theta)

    np.testing.assert_allclose(residual, problem.residual(theta), atol=1e-4)
    np.testing.assert_allclose(slope, problem.sensitivity(theta), atol=1e-4 * np.abs(slope).max())
