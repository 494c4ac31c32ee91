"""The contract every estimator keeps, over every implementation."""

from dataclasses import replace

import numpy as np
import pytest

from hdt_benchmark.spring_mass_damper import TRUTH, oscillator_problem
from hdt_core.estimation import Belief, Problem, estimators, unknown

EVERY = pytest.mark.parametrize("estimator", estimators().values(), ids=lambda e: e.name)
TIME_S = np.linspace(0.0, 4.0, 60)
LEVEL = 2.0
RATE = 0.8


def decay(seed=0, level=LEVEL, rate=RATE, bounds=((0.0, 10.0), (0.0, 5.0))):
    """A value that decays: no states, every sample stands alone."""
    noise = 0.05 * np.random.default_rng(seed).standard_normal((TIME_S.size, 1))
    return Problem(
        names=("level", "rate"),
        bounds=np.array(bounds),
        prior=Belief(np.array([1.5, 0.5]), np.diag([1.0, 0.5]) ** 2),
        measured=(level * np.exp(-rate * TIME_S))[:, None] + noise,
        sigma=np.array([0.05]),
        observe=lambda _x, theta, i: (theta[0] * np.exp(-theta[1] * TIME_S[i]))[None],
    )


def lag(seed=0, gain=1.5, pole=0.9):
    """A first-order lag behind a swinging input: one state, two parameters."""
    swing = 0.3 + np.sin(np.arange(150) / 8.0)
    x = 0.0
    position = []
    for u in swing:
        position.append(x)
        x = pole * x + (1.0 - pole) * gain * u
    noise = 0.05 * np.random.default_rng(seed).standard_normal((150, 1))
    return Problem(
        names=("gain", "pole"),
        bounds=np.array([[0.0, 5.0], [0.0, 0.999]]),
        prior=Belief(np.array([1.0, 0.8]), np.diag([0.5, 0.1]) ** 2),
        measured=np.array(position)[:, None] + noise,
        sigma=np.array([0.05]),
        observe=lambda x, _theta, _i: x,
        transition=lambda x, theta, i: theta[1] * x + (1.0 - theta[1]) * theta[0] * swing[i],
        start=Belief(np.zeros(1), np.zeros((1, 1))),
    )


@EVERY
@pytest.mark.parametrize("seed", [0, 1])
def test_recovers_static_parameters(estimator, seed):
    estimate = estimator.estimate(decay(seed))
    assert estimate.status == "converged"
    assert (np.abs(estimate.belief.mean - [LEVEL, RATE]) < 4.0 * estimate.belief.sd).all()
    assert (estimate.belief.sd < 0.2).all()


@EVERY
def test_recovers_dynamic_parameters(estimator):
    estimate = estimator.estimate(lag())
    assert estimate.status == "converged"
    assert (np.abs(estimate.belief.mean - [1.5, 0.9]) < 4.0 * estimate.belief.sd).all()
    assert (estimate.belief.sd < 0.2).all()
    estimate = estimator.estimate(oscillator_problem(11))
    assert estimate.status == "converged"
    assert (np.abs(estimate.belief.mean - TRUTH) < 4.0 * estimate.belief.sd).all()
    assert (estimate.belief.sd < 2.0 * np.array([0.0121, 0.0171])).all()


@EVERY
def test_same_problem_gives_same_answer(estimator):
    first = estimator.estimate(decay())
    second = estimator.estimate(decay())
    np.testing.assert_array_equal(first.belief.mean, second.belief.mean)
    np.testing.assert_array_equal(first.belief.cov, second.belief.cov)
    estimate = estimator.estimate(decay())
    np.testing.assert_allclose(estimate.belief.cov, estimate.belief.cov.T, atol=1e-15)
    assert (np.linalg.eigvalsh(estimate.belief.cov) > 0.0).all()
    assert estimate.n_evals > 0
    assert estimate.identifiability.identifiable
    assert np.isfinite(estimate.identifiability.condition)


@EVERY
def test_reports_active_bound(estimator):
    estimate = estimator.estimate(decay(bounds=((0.0, 10.0), (0.0, 0.4))))
    assert 0.0 <= estimate.belief.mean[1] <= 0.4
    assert estimate.belief.mean[1] > 0.3
    if estimator.name != "particle":  # a cloud's mean lies off the wall it leans on
        assert estimate.status == "at_bound"
    if estimate.path is not None:
        assert (estimate.path >= 0.0).all()
        assert (estimate.path[:, 1] <= 0.4).all()
    estimate = estimator.estimate(decay(bounds=((0.0, 10.0), (0.8, 0.8))))
    assert estimate.belief.mean[1] == pytest.approx(0.8, abs=1e-12)
    assert abs(estimate.belief.mean[0] - LEVEL) < 4.0 * estimate.belief.sd[0]
    assert estimate.belief.sd[1] == pytest.approx(0.0, abs=1e-9)


@EVERY
@pytest.mark.parametrize("upper", [0.9, 0.89])
def test_estimate_stays_within_its_bounds(estimator, upper):
    wide = lag(pole=0.9)
    bounds = wide.bounds.copy()
    bounds[1, 1] = upper
    plain = replace(estimator, polish=False) if hasattr(estimator, "polish") else estimator

    mean = plain.estimate(replace(wide, bounds=bounds)).belief.mean

    assert mean[1] <= upper


@EVERY
def test_ignores_missing_values(estimator):
    whole = decay()
    holed = whole.measured.copy()
    holed[::3] = np.nan
    estimate = estimator.estimate(replace(whole, measured=holed))
    assert (np.abs(estimate.belief.mean - [LEVEL, RATE]) < 4.0 * estimate.belief.sd).all()
    assert (estimate.belief.sd > estimator.estimate(whole).belief.sd * 0.9).all()
    blank = replace(decay(), measured=np.full((TIME_S.size, 1), np.nan), bounds=np.tile([-20.0, 20.0], (2, 1)))
    estimate = estimator.estimate(blank)
    mean_share, sd_share = (0.3, 0.2) if estimator.name == "particle" else (0.01, 0.01)
    assert (np.abs(estimate.belief.mean - blank.prior.mean) < mean_share * blank.prior.sd).all()
    np.testing.assert_allclose(estimate.belief.sd, blank.prior.sd, rtol=sd_share)


@EVERY
def test_product_is_not_identifiable(estimator):
    whole = decay()
    product = replace(
        whole,
        names=("area", "speed"),
        bounds=np.array([[0.1, 10.0], [0.1, 10.0]]),
        prior=unknown(np.array([1.0, 1.5])),
        measured=np.full((60, 1), 3.0) + 0.05 * np.random.default_rng(2).standard_normal((60, 1)),
        observe=lambda _x, theta, i: (theta[0] * theta[1] + 0.0 * np.asarray(i))[None],
    )
    estimate = estimator.estimate(product)
    assert estimate.status == "not_identifiable"
    assert estimate.identifiability.condition > 1e12
    assert set(estimate.identifiability.weakest) == {"area", "speed"}


def test_estimators_agree_on_optimum():
    beliefs = {e.name: e.estimate(decay()).belief for e in estimators().values()}
    for name in ("pso", "genetic", "gradient_descent", "pinn"):
        away = np.abs(beliefs[name].mean - beliefs["nls"].mean) / beliefs["nls"].sd
        assert (away < 2e-3).all(), name
    for name in ("ekf", "ukf", "ekf_pso", "particle"):
        away = np.abs(beliefs[name].mean - beliefs["nls"].mean) / beliefs["nls"].sd
        assert (away < 0.25).all(), name


@EVERY
@pytest.mark.parametrize("dynamic", [False, True])
def test_failed_model_diverges(estimator, dynamic):
    if dynamic:
        broken = replace(lag(), transition=lambda x, theta, _i: np.nan * x * theta[1])
    else:
        broken = replace(decay(), observe=lambda _x, theta, i: (np.nan * theta[0] * TIME_S[i])[None])
    estimate = estimator.estimate(broken)
    assert estimate.status == "diverged"
    np.testing.assert_array_equal(estimate.belief.mean, broken.prior.mean)
