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
@pytest.mark.parametrize(
    ("problem", "truth", "most_sd"),
    [(lag(), [1.5, 0.9], 0.2), (oscillator_problem(11), TRUTH, 2.0 * np.array([0.0121, 0.0171]))],
    ids=["lag", "oscillator"],
)
def test_recovers_dynamic_parameters(estimator, problem, truth, most_sd):
    """Of the oscillator from a wrong guess."""
    estimate = estimator.estimate(problem)
    assert estimate.status == "converged"
    assert (np.abs(estimate.belief.mean - truth) < 4.0 * estimate.belief.sd).all()
    assert (estimate.belief.sd < most_sd).all()


@EVERY
def test_same_problem_gives_same_answer(estimator):
    first, second = (estimator.estimate(decay()).belief for _ in range(2))
    np.testing.assert_array_equal(first.mean, second.mean)
    np.testing.assert_array_equal(first.cov, second.cov)


@EVERY
def test_covariance_is_positive_definite(estimator):
    cov = estimator.estimate(decay()).belief.cov
    np.testing.assert_allclose(cov, cov.T, atol=1e-15)
    assert (np.linalg.eigvalsh(cov) > 0.0).all()


@EVERY
def test_counts_its_evaluations(estimator):
    assert estimator.estimate(decay()).n_evals > 0


@EVERY
def test_decay_is_identifiable(estimator):
    identifiability = estimator.estimate(decay()).identifiability
    assert identifiability.identifiable
    assert np.isfinite(identifiability.condition)


@EVERY
def test_reports_active_bound(estimator):
    estimate = estimator.estimate(decay(bounds=((0.0, 10.0), (0.0, 0.4))))
    assert 0.3 < estimate.belief.mean[1] <= 0.4
    if estimator.name != "particle":  # a cloud's mean lies off the wall it leans on
        assert estimate.status == "at_bound"
    if estimate.path is not None:
        assert (estimate.path >= 0.0).all()
        assert (estimate.path[:, 1] <= 0.4).all()


@EVERY
def test_fixed_parameter_stays(estimator):
    belief = estimator.estimate(decay(bounds=((0.0, 10.0), (0.8, 0.8)))).belief
    assert belief.mean[1] == pytest.approx(0.8, abs=1e-12)
    assert abs(belief.mean[0] - LEVEL) < 4.0 * belief.sd[0]
    assert belief.sd[1] == pytest.approx(0.0, abs=1e-9)


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


@EVERY
def test_empty_record_leaves_the_prior(estimator):
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


@pytest.mark.parametrize(
    ("name", "share"),
    [
        *[(name, 2e-3) for name in ("pso", "genetic", "gradient_descent", "pinn")],
        *[(name, 0.25) for name in ("ekf", "ukf", "ekf_pso", "particle")],
    ],
)
def test_estimators_agree_on_optimum(name, share):
    one, best = (estimators()[n].estimate(decay()).belief for n in (name, "nls"))
    assert (np.abs(one.mean - best.mean) < share * best.sd).all()


@EVERY
@pytest.mark.parametrize(
    "broken",
    [
        replace(lag(), transition=lambda x, theta, _i: np.nan * x * theta[1]),
        replace(decay(), observe=lambda _x, theta, i: (np.nan * theta[0] * TIME_S[i])[None]),
    ],
    ids=["transition", "output"],
)
def test_failed_model_diverges(estimator, broken):
    """And raises nothing."""
    estimate = estimator.estimate(broken)
    assert estimate.status == "diverged"
    np.testing.assert_array_equal(estimate.belief.mean, broken.prior.mean)
