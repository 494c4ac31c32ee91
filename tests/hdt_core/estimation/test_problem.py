"""The question itself: beliefs, missing values, and one flight after another."""

from dataclasses import replace

import numpy as np
import pytest

from hdt_core.estimation import Belief, ExtendedKalman, NonlinearLeastSquares, Problem, unknown
from hdt_estimators import ParticleFilter

SLOPE = np.random.default_rng(5).uniform(0.5, 2.0, 40)


def line(measured=None, prior=None, **more):
    truth = 1.2 * SLOPE + 0.4
    noise = 0.1 * np.random.default_rng(6).standard_normal(40)
    return Problem(
        names=("gain", "offset"),
        bounds=np.tile([-50.0, 50.0], (2, 1)),
        prior=unknown(np.zeros(2)) if prior is None else prior,
        measured=(truth + noise)[:, None] if measured is None else measured,
        sigma=np.array([0.1]),
        observe=lambda _x, theta, i: (theta[0] * SLOPE[i] + theta[1])[None],
        **more,
    )


def test_one_point_and_a_swarm_are_simulated_alike():
    problem = line()
    thetas = np.random.default_rng(0).normal(size=(4, 2))
    many = problem.simulate(thetas)
    assert many.shape == (4, 40, 1)
    for row, outputs in zip(thetas, many, strict=True):
        np.testing.assert_array_equal(problem.simulate(row), outputs)
    np.testing.assert_allclose(problem.chi2(thetas), [np.sum(problem.residual(row) ** 2) for row in thetas])


def test_posterior_of_one_half_is_the_prior_of_the_other():
    whole = line()
    parts = []
    for half in (slice(0, 20), slice(20, 40)):
        measured = np.full((40, 1), np.nan)
        measured[half] = whole.measured[half]
        parts.append(measured)
    estimator = NonlinearLeastSquares()
    first = estimator.estimate(replace(whole, measured=parts[0]))
    second = estimator.estimate(replace(whole, measured=parts[1]).with_prior(first.belief))
    together = estimator.estimate(whole)
    np.testing.assert_allclose(second.belief.mean, together.belief.mean, atol=1e-9)
    np.testing.assert_allclose(second.belief.cov, together.belief.cov, atol=1e-9)


def walk(seed):
    """A level that walks, told by noisy values: drift of the parameter, no states."""
    rng = np.random.default_rng(seed)
    level = 1.0 + np.cumsum(0.05 * rng.standard_normal(200))
    problem = Problem(
        names=("level",),
        bounds=np.array([[-20.0, 20.0]]),
        prior=Belief(np.array([1.0]), np.array([[0.25]])),
        measured=(level + 0.2 * rng.standard_normal(200))[:, None],
        sigma=np.array([0.2]),
        observe=lambda _x, theta, i: theta[:1] + 0.0 * np.asarray(i),
        drift=np.array([0.05]),
    )
    return level, problem


@pytest.mark.parametrize("estimator", [ExtendedKalman(), ParticleFilter(n_particles=1500)], ids=lambda e: e.name)
def test_a_parameter_that_drifts_is_followed(estimator):
    level, problem = walk(3)
    estimate = estimator.estimate(problem)
    rms = np.sqrt(np.mean((estimate.path[20:, 0] - level[20:]) ** 2))
    # steady state of the random walk: variance P with P^2 / (P + R) = Q, after the sample P R / (P + R)
    q, r = 0.05**2, 0.2**2
    before = 0.5 * (q + np.sqrt(q * q + 4.0 * q * r))
    after = np.sqrt(before * r / (before + r))
    assert rms < 1.4 * after
    assert estimate.path_sd[-1, 0] == pytest.approx(after, rel=0.02 if estimator.name == "ekf" else 0.25)


def test_particles_carry_states_that_are_drawn():
    rng = np.random.default_rng(9)
    x, measured = 0.0, []
    for _ in range(150):
        measured.append(x + 0.3 * rng.standard_normal())
        x = 0.8 * x + 0.5 * rng.standard_normal()
    problem = Problem(
        names=("pole",),
        bounds=np.array([[0.0, 0.99]]),
        prior=Belief(np.array([0.5]), np.array([[0.09]])),
        measured=np.array(measured)[:, None],
        sigma=np.array([0.3]),
        observe=lambda x, _theta, _i: x,
        transition=lambda x, theta, _i: theta[0] * x,
        start=Belief(np.zeros(1), np.array([[0.01]])),
        process_sd=np.array([0.5]),
    )
    for estimator in (ParticleFilter(n_particles=2000), ExtendedKalman(smoother_passes=0)):
        estimate = estimator.estimate(problem)
        assert abs(estimate.belief.mean[0] - 0.8) < 4.0 * estimate.belief.sd[0]
        assert estimate.belief.sd[0] < 0.15
