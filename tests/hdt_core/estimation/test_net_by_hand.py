"""A physics-informed net against sums written out: its states, loss, first weights, covariance and training."""

from dataclasses import replace

import numpy as np
import pytest

from hdt_core.estimation import (
    Belief,
    NonlinearLeastSquares,
    PhysicsInformedNet,
    Problem,
)
from hdt_core.estimation.pinn import _first_weights, _loss, _parameter_cov, _Scale, _states, _train, _with_slopes

# a net of two hidden units for one state: a + w1 tanh(s1 t + c1) + w2 tanh(s2 t + c2), times the state's size
WEIGHTS = np.array([1.5, -0.8, 0.2, 0.4, 0.7, -0.3, 0.1])
SCALE = _Scale(np.array([0.0, 0.5, 1.0]), np.array([2.0]), np.array([0.25]))


def swing() -> Problem:
    return Problem(
        ("gain", "pole"),
        np.array([[0.0, 5.0], [0.0, 1.0]]),
        Belief(np.array([1.0, 0.8]), np.diag([0.25, 0.01])),
        np.array([[1.0], [np.nan], [0.7]]),
        np.array([0.2]),
        lambda x, t, _i: t[0] * x,
        lambda x, t, i: t[1] * x + 0.1 * np.asarray(i),
        Belief(np.array([1.2]), np.array([[0.04]])),
    )


def test_a_nets_states_and_its_loss_by_hand():
    time, theta = SCALE.time, np.array([1.1, 0.9])
    x = 2.0 * (0.7 * np.tanh(1.5 * time + 0.2) - 0.3 * np.tanh(-0.8 * time + 0.4) + 0.1)
    states, by = _states(WEIGHTS, time, SCALE.size, 2)
    np.testing.assert_allclose(states, x[None])
    vector, rho = np.concatenate([WEIGHTS, theta]), 0.1
    residual, jacobian = _loss(swing(), vector, SCALE, rho, 2)
    later = 0.9 * x[:-1] + 0.1 * np.arange(2)
    expected = [(1.1 * x[0] - 1.0) / 0.2, 0.0, (1.1 * x[2] - 0.7) / 0.2, *((x[1:] - later) / (0.1 * 0.25)),
                (x[0] - 1.2) / 0.2, 0.1 / 0.5, 0.1 / 0.1]  # fmt: skip
    np.testing.assert_allclose(residual, expected, rtol=1e-6)
    for j in range(vector.size):
        step = np.zeros(vector.size)
        step[j] = 1e-6
        ends = [_loss(swing(), vector + sign * step, SCALE, rho, 2)[0] for sign in (1.0, -1.0)]
        np.testing.assert_allclose(jacobian[:, j], (ends[0] - ends[1]) / 2e-6, rtol=1e-5, atol=1e-5)
        if j < 7:
            shifted = [_states(WEIGHTS + sign * step[:7], time, SCALE.size, 2)[0] for sign in (1.0, -1.0)]
            np.testing.assert_allclose(by[..., j], (shifted[0] - shifted[1]) / 2e-6, rtol=1e-5, atol=1e-7)
    # a start known exactly counts by a thousandth of the state's size
    exact = replace(swing(), start=Belief(np.array([1.2]), np.zeros((1, 1))))
    assert _loss(exact, vector, SCALE, rho, 2)[0][-3] == pytest.approx((x[0] - 1.2) / 2e-3)
    value, by_x, by_theta = _with_slopes(
        lambda x, t, i: x * t[0] ** 2 + i, np.array([[1.0, 2.0]]), np.array([3.0]), np.arange(2)
    )
    np.testing.assert_allclose(value, [[9.0, 19.0]])
    np.testing.assert_allclose(by_x, [[[9.0, 9.0]]], rtol=1e-6)
    np.testing.assert_allclose(by_theta, [[[6.0, 12.0]]], rtol=1e-6)


def test_a_nets_first_weights_are_the_simulation_and_turn_all_along_the_record():
    guess = np.column_stack([np.cos(np.linspace(0.0, 6.0, 80)), 3.0 * np.sin(np.linspace(0.0, 6.0, 80))])
    scale = _Scale(np.linspace(0.0, 1.0, 80), np.array([1.0, 3.0]), np.ones(2))
    first = _first_weights(30, guess, scale, np.random.default_rng(0))
    slope, shift = first[:30], first[30:60]
    assert ((np.abs(slope) >= 0.3 * 30) & (np.abs(slope) <= 30)).all()
    assert 5 < (slope > 0).sum() < 25
    np.testing.assert_allclose(-shift / slope, np.linspace(-0.05, 1.05, 30), atol=1e-12)
    np.testing.assert_allclose(_states(first, scale.time, scale.size, 30)[0].T, guess, atol=0.03)


def test_covariance_of_the_parameters_of_a_net():
    normal = np.array([[4.0, 1.0, 0.5], [1.0, 9.0, 2.0], [0.5, 2.0, 3.0]])
    np.testing.assert_allclose(_parameter_cov(normal, 2), np.linalg.inv(normal)[1:, 1:], rtol=1e-9)
    blind = np.zeros((3, 3))
    blind[1:, 1:] = normal[1:, 1:]
    np.testing.assert_allclose(_parameter_cov(blind, 2), np.linalg.inv(normal[1:, 1:]), rtol=1e-9)


def lag() -> Problem:
    x, outputs = 1.0, []
    for i in range(40):
        outputs.append(x + 0.01 * (-1.0) ** i)
        x = 0.9 * x + 0.1 * np.sin(i / 4.0)
    return Problem(
        ("gain", "pole"),
        np.array([[0.0, 5.0], [0.0, 0.999]]),
        Belief(np.array([0.9, 0.8]), np.diag([0.04, 0.01])),
        np.array(outputs)[:, None],
        np.array([0.01]),
        lambda x, t, _i: t[0] * x,
        lambda x, t, i: t[1] * x + 0.1 * np.sin(np.asarray(i) / 4.0),
        Belief(np.ones(1), np.zeros((1, 1))),
    )


def test_a_net_counts_its_steps_and_stops_where_its_parameters_stand_still():
    """Each step differs the model by a state and two parameters: seven passes."""
    one = PhysicsInformedNet(width=8, max_steps=1, polish=False).estimate(lag())
    assert (one.n_evals, one.method, one.status) == (2 * 7, "pinn", "approximate")
    done = PhysicsInformedNet(width=8, polish=False).estimate(lag())
    assert 7 * 2 * 4 <= done.n_evals < 7 * 200
    assert done.n_evals % 7 == 0
    polished = PhysicsInformedNet(width=8).estimate(lag())
    best = NonlinearLeastSquares().estimate(lag())
    assert polished.n_evals > done.n_evals
    np.testing.assert_allclose(polished.belief.mean, best.belief.mean, atol=1e-3 * best.belief.sd.min())
    assert (np.abs(done.belief.mean - best.belief.mean) < 3.0 * done.belief.sd).all()
    # at the loss's minimum no step moves a parameter by 3e-4 of its deviation: three in a row and it ends
    scale = _Scale(np.linspace(0.0, 1.0, 40), np.ones(1), np.full(1, 0.05))
    start = np.concatenate([_first_weights(8, lag().measured, scale, np.random.default_rng(0)), lag().origin])
    vector, normal, _ = _train(lag(), start, scale, 0.1, width=8, max_steps=400)
    residual, slope = _loss(lag(), vector, scale, 0.1, 8)
    np.testing.assert_allclose(normal, slope.T @ slope, rtol=1e-9)
    assert _train(lag(), vector, scale, 0.1, width=8, max_steps=400)[2] <= 4
    assert _train(lag(), start, scale, 0.1, width=8, max_steps=2)[2] == 2
    assert residual @ residual < sum(np.square(_loss(lag(), start, scale, 0.1, 8)[0]))


def trained_by_hand(problem, vector, scale, rho, most):
    """Levenberg and Marquardt, damped by a thousandth at first, four times more where a step does not pay and a fifth
    after one that does; over once three undamped steps in a row move each parameter by 3e-4 of its deviation."""
    mu, still, steps, n = 1e-3, 0, 0, 2
    while steps < most and still < 3:
        steps, (r, slope) = steps + 1, _loss(problem, vector, scale, rho, 8)
        normal, later = slope.T @ slope, np.inf
        while not later < r @ r:
            move = np.linalg.solve(normal + mu * np.diag(np.diag(normal) + 1e-12), -slope.T @ r)
            trial = vector + move
            trial[-n:] = np.clip(trial[-n:], *problem.bounds.T)
            later = np.sum(_loss(problem, trial, scale, rho, 8)[0] ** 2)
            mu *= 1.0 if later < r @ r else 4.0
        small = np.abs(move[-n:]) <= 3e-4 * np.sqrt(np.diag(_parameter_cov(normal, n)))
        still = still + 1 if mu <= 1e-3 and small.all() else 0
        vector, mu = trial, 0.2 * mu
    return vector, steps


@pytest.mark.parametrize(("rho", "gain"), [(0.1, 0.9), (0.01, 3.0)])
@pytest.mark.parametrize("most", [1, 2, 5, 100])
def test_a_net_is_trained_step_by_step(rho, gain, most):
    scale = _Scale(np.linspace(0.0, 1.0, 40), np.ones(1), np.full(1, 0.05))
    first = _first_weights(8, lag().measured, scale, np.random.default_rng(0))
    start = np.concatenate([first, [gain, 0.8]])
    vector, steps = trained_by_hand(lag(), start, scale, rho, most)
    weights, _, tried = _train(lag(), start, scale, rho, width=8, max_steps=most)
    assert tried == steps
    np.testing.assert_allclose(weights[-2:], vector[-2:], rtol=1e-6)


def test_a_net_that_loses_its_states_stops_at_once():
    undefined = replace(lag(), transition=lambda x, _t, _i: np.nan * x)
    assert PhysicsInformedNet().estimate(undefined).n_evals == 1
