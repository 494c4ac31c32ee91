"""States from their rates: against closed forms and against SciPy at tolerances far tighter than ours."""

import numpy as np
import pytest
from scipy.integrate import RK45, solve_ivp

from hdt_core.estimation import NonlinearLeastSquares, UnscentedKalman, unknown
from hdt_core.estimation.declared import declared_problem
from hdt_core.physics.integrators import advance_states
from hdt_core.physics.model import Param, PhysicsModel, Signal, State


def van_der_pol(solver="adaptive", mu=1.0):
    def rates(mu, x0, x1):
        return x1, mu * (1.0 - x0**2) * x1 - x0

    return PhysicsModel(
        name="van_der_pol",
        inputs=(),
        outputs=(Signal("seen", "-", sigma=0.01),),
        params=(Param("mu", "-", mu, (0.01, 2000.0), "design"),),
        states=(State("x0", "-", 2.0), State("x1", "-", 0.0)),
        equations=lambda mu, x0, x1: x0 + 0.0 * mu,
        rates=rates,
        solver=solver,
    )


def truth(mu, n, dt_s):
    solution = solve_ivp(
        lambda _t, x: [x[1], mu * (1.0 - x[0] ** 2) * x[1] - x[0]],
        (0.0, dt_s * (n - 1)),
        [2.0, 0.0],
        method="LSODA",
        t_eval=dt_s * np.arange(n),
        rtol=1e-11,
        atol=1e-12,
    )
    return solution.y[0]


def position_error(solver):
    positions = van_der_pol(solver).simulate({}, {}, 0.01, n_samples=2001)["seen"]
    return np.abs(positions - truth(1.0, 2001, 0.01)).max()


@pytest.mark.parametrize(("solver", "error"), [("adaptive", 1e-6), ("rk4", 1e-6), ("euler", 0.5)])
def test_solvers_follow_van_der_pol(solver, error):
    assert position_error(solver) < error


def test_euler_errs_at_hundredth_second():
    """Why it is taken by name only."""
    assert position_error("euler") > 0.02


def test_stiff_oscillator_is_solved():
    positions = van_der_pol(mu=1000.0).simulate({}, {}, 100.0, n_samples=6)["seen"]
    np.testing.assert_allclose(positions, truth(1000.0, 6, 100.0), atol=1e-5)


def test_exploding_member_fails_alone():
    """x' = -x; x' = x^2, which ends at 1 s; no start."""
    start = np.array([[1.0, 1.0, np.nan]])
    grow = np.array([[0.0, 1.0, 0.0]])
    fall = np.array([[1.0, 0.0, 1.0]])
    later = advance_states(lambda x: grow * x**2 - x * fall, start, 2.0, "adaptive")
    assert later[0] == pytest.approx([np.exp(-2.0), np.nan, np.nan], rel=1e-7, nan_ok=True)


def cosine_error(solver, dt_s):
    """Error of an oscillator after 2 s."""
    x = np.array([1.0, 0.0])
    for _ in range(round(2.0 / dt_s)):
        x = advance_states(lambda y: np.array([y[1], -y[0]]), x, dt_s, solver)
    return abs(x[0] - np.cos(2.0))


@pytest.mark.parametrize(("solver", "dt_s", "order", "off"), [("euler", 0.01, 1.0, 0.1), ("rk4", 0.1, 4.0, 0.2)])
def test_solvers_have_nominal_order(solver, dt_s, order, off):
    halved = cosine_error(solver, dt_s) / cosine_error(solver, dt_s / 2.0)
    assert np.log2(halved) == pytest.approx(order, abs=off)


def test_adaptive_steps_meet_tolerance():
    assert cosine_error("adaptive", 0.5) < 1e-7


def test_sensitivity_solves_variational_equation():
    mu = 1.1

    def both(_t, y):
        x, v, dx, dv = y
        return [v, mu * (1 - x**2) * v - x, dv, (1 - x**2) * v + mu * (1 - x**2) * dv - (2 * mu * x * v + 1) * dx]

    exact = solve_ivp(both, (0.0, 5.0), [2.0, 0.0, 0.0, 0.0], t_eval=0.01 * np.arange(501), rtol=1e-11, atol=1e-12)
    slope = record().sensitivity(np.array([mu]))[:, 0] * 0.01
    np.testing.assert_allclose(slope, exact.y[2], atol=1e-5 * np.abs(exact.y[2]).max())


def step_states(rates, x, dt_s):
    """Dormand and Prince's steps, all columns alike: an error of 1e-8 of each state's size, of a thousandth of its
    largest column's at the least; a step changes by the fifth root of error over that, to a tenth or five times."""
    done = 0.0
    step = dt_s
    while done < dt_s * (1.0 - 1e-12):
        stages = [rates(x)]
        for row in RK45.A[1:]:
            stages.append(rates(x + step * np.tensordot(row[: len(stages)], stages, 1)))
        later = x + step * np.tensordot(RK45.B, stages, 1)
        error = np.abs(step * np.tensordot(RK45.E, [*stages, rates(later)], 1))
        size = np.maximum(np.abs(x), np.abs(later))
        worst = (error / (1e-8 * np.maximum(size, 1e-3 * size.max(axis=1, keepdims=True)) + 1e-14)).max()
        if worst <= 1.0:
            x = later
            done += step
        step = min(step * np.clip(0.9 * max(worst, 1e-9) ** -0.2, 0.1, 5.0), dt_s - done)
    return x


def test_adaptive_steps_follow_the_error():
    """A fast decay that breaks off into a slow one; the second column is small, and faster."""

    def rates(x):
        return np.concatenate([np.where(x[:, :1] > 0.5, -40.0 * x[:, :1], -0.5 - 0.01 * x[:, :1]), -60.0 * x[:, 1:]], 1)

    start = np.array([[1.0, 2e-4]])
    np.testing.assert_allclose(advance_states(rates, start, 2.0, "adaptive"), step_states(rates, start, 2.0), rtol=1e-9)


def record(seed=0, solver="adaptive"):
    measured = truth(1.0, 501, 0.01) + 0.01 * np.random.default_rng(seed).standard_normal(501)
    model = van_der_pol(solver)
    return declared_problem(model, ["mu"], {}, {"seen": measured}, prior=unknown(np.array([1.4])), dt_s=0.01)


def test_least_squares_recovers_damping():
    right = NonlinearLeastSquares().estimate(record())
    assert right.status == "converged"
    assert abs(right.belief.mean[0] - 1.0) < 4.0 * right.belief.sd[0]
    assert right.step_error[0] == pytest.approx(0.0, abs=1e-3)


def test_euler_states_its_step_error():
    wrong = NonlinearLeastSquares().estimate(record(solver="euler"))
    away = (wrong.belief.mean[0] - 1.0) / wrong.belief.sd[0]
    assert abs(away) > 10.0
    assert wrong.fit.verdict == "lack_of_fit"
    # half the step takes away half the error of a method of first order
    assert -wrong.step_error[0] == pytest.approx(0.5 * away, rel=0.3)
    assert "error of the step" in wrong.summary()


def test_unscented_filter_recovers_damping():
    estimate = UnscentedKalman(smoother_passes=1).estimate(record())
    assert estimate.status == "converged"
    assert abs(estimate.belief.mean[0] - 1.0) < 4.0 * estimate.belief.sd[0]
