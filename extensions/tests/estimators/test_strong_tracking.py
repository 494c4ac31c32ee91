"""Filters that forget: what jumps is followed, what stands still is not blurred, and the statement stays honest."""

from dataclasses import replace

import numpy as np
import pytest

from hdt_core.estimation import Belief, ExtendedKalman, Problem
from hdt_estimators import RecursiveLeastSquares, StrongTracking
from hdt_estimators.strong_tracking import classify

JUMP_AT, N = 120, 240


def gain_record(seed, before=1.0, after=1.6):
    rng = np.random.default_rng(seed)
    u = 1.0 + 0.5 * np.sin(np.arange(N) / 7.0)
    gain = np.where(np.arange(N) < JUMP_AT, before, after)
    return Problem(
        names=("gain",),
        bounds=np.array([[0.0, 5.0]]),
        prior=Belief(np.array([1.0]), np.array([[1.0]])),
        measured=(gain * u + 0.1 * rng.standard_normal(N))[:, None],
        sigma=np.array([0.1]),
        observe=lambda _x, theta, i: (theta[0] * u[i])[None],
    )


def test_a_jump_is_followed_where_the_plain_filter_lags():
    problem = gain_record(0)
    tracked, plain = StrongTracking().estimate(problem), ExtendedKalman(smoother_passes=0).estimate(problem)
    assert abs(tracked.path[JUMP_AT + 15, 0] - 1.6) < 0.1
    assert abs(plain.path[JUMP_AT + 15, 0] - 1.6) > 0.4
    assert abs(tracked.belief.mean[0] - 1.6) < 4.0 * tracked.belief.sd[0]


def test_without_a_jump_it_is_the_plain_filter():
    problem = gain_record(1, after=1.0)
    tracked, plain = StrongTracking().estimate(problem), ExtendedKalman(smoother_passes=0).estimate(problem)
    np.testing.assert_allclose(tracked.belief.mean, plain.belief.mean, atol=1e-9)
    np.testing.assert_allclose(tracked.belief.cov, plain.belief.cov, rtol=1e-6)


def test_classification_tells_the_jump_and_its_time():
    problem = gain_record(2)
    classification = classify(
        problem.names, StrongTracking().estimate(problem), Belief(np.array([1.0]), np.array([[0.02**2]]))
    )
    first = classification.first()["gain"]
    assert first is not None
    assert JUMP_AT <= first <= JUMP_AT + 20
    quiet = gain_record(3, after=1.0)
    none = classify(quiet.names, StrongTracking().estimate(quiet), Belief(np.array([1.0]), np.array([[0.02**2]])))
    assert none.first()["gain"] is None or none.probability[JUMP_AT:].max() < 0.95


def test_classification_needs_a_path():
    from hdt_core.estimation import NonlinearLeastSquares

    problem = gain_record(0)
    with pytest.raises(ValueError, match="path"):
        classify(problem.names, NonlinearLeastSquares().estimate(problem), problem.prior)


def test_recursive_least_squares_is_the_weighted_sum_of_the_textbook():
    problem, forgetting = gain_record(4, after=1.0), 0.97
    u = np.ravel(problem.simulate(np.array([1.0])))
    weight = forgetting ** np.arange(N - 1, -1, -1) / 0.01
    # the prior is forgotten too, once before every sample
    prior = forgetting**N
    information = (weight * u**2).sum() + prior
    expected = ((weight * u * problem.measured[:, 0]).sum() + prior * 1.0) / information
    estimate = RecursiveLeastSquares(forgetting=forgetting).estimate(problem)
    assert estimate.belief.mean[0] == pytest.approx(expected, abs=2e-6)
    # what it states is the scatter that such weights leave, not what the faded covariance says
    scatter = np.sqrt((weight**2 * u**2 * 0.01).sum()) / information
    assert estimate.belief.sd[0] == pytest.approx(scatter, rel=1e-3)


@pytest.mark.parametrize("estimator", [RecursiveLeastSquares(forgetting=0.97), StrongTracking()], ids=lambda e: e.name)
def test_intervals_hold_what_they_promise(estimator):
    inside = []
    for seed in range(120):
        whole = gain_record(100 + seed, after=1.0)
        belief = estimator.estimate(replace(whole, measured=whole.measured[:80])).belief
        inside.append(abs(belief.mean[0] - 1.0) < 1.6449 * belief.sd[0])
    assert np.mean(inside) == pytest.approx(0.9, abs=0.07)  # 120 records: two and a half times 0.027
