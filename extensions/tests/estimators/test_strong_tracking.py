"""Filters that forget follow what jumps and blur nothing else; gains of further sensors are as in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from compressor_problem import AREA_M2, BETA_RAD, DIAMETER_M, SPEED_RAD_S, compressor, flow_kg_s

from hdt_core.estimation import Belief, ExtendedKalman, NonlinearLeastSquares, Problem
from hdt_estimators import RecursiveLeastSquares, StrongTracking
from hdt_estimators.experiment import Candidate, rank_sensors
from hdt_estimators.strong_tracking import classify

JUMP_AT = 120
N = 240


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


def filtered(problem):
    """By strong tracking and by the plain filter."""
    return StrongTracking().estimate(problem), ExtendedKalman(smoother_passes=0).estimate(problem)


def test_jump_is_followed_without_lag():
    tracked, plain = filtered(gain_record(0))
    assert abs(tracked.path[JUMP_AT + 15, 0] - 1.6) < 0.1
    assert abs(plain.path[JUMP_AT + 15, 0] - 1.6) > 0.4
    assert abs(tracked.belief.mean[0] - 1.6) < 4.0 * tracked.belief.sd[0]


def test_quiet_record_keeps_plain_filter():
    tracked, plain = filtered(gain_record(1, after=1.0))
    np.testing.assert_allclose(tracked.belief.mean, plain.belief.mean, atol=1e-9)
    np.testing.assert_allclose(tracked.belief.cov, plain.belief.cov, rtol=1e-6)


NOMINAL = Belief(np.array([1.0]), np.array([[0.02**2]]))


def test_classification_dates_jump():
    problem = gain_record(2)
    first = classify(problem.names, StrongTracking().estimate(problem), NOMINAL).first()["gain"]
    assert first is not None
    assert JUMP_AT <= first <= JUMP_AT + 20


def test_classification_of_quiet_record_is_unsure():
    quiet = gain_record(3, after=1.0)
    none = classify(quiet.names, StrongTracking().estimate(quiet), NOMINAL)
    assert none.first()["gain"] is None or none.probability[JUMP_AT:].max() < 0.95


def test_classification_needs_path():
    problem = gain_record(0)
    with pytest.raises(ValueError, match="path"):
        classify(problem.names, NonlinearLeastSquares().estimate(problem), problem.prior)


def test_recursive_least_squares_equal_weighted_sum():
    """As in the textbook."""
    problem = gain_record(4, after=1.0)
    forgetting = 0.97
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
def test_intervals_cover_as_promised(estimator):
    inside = []
    for seed in range(120):
        whole = gain_record(100 + seed, after=1.0)
        belief = estimator.estimate(replace(whole, measured=whole.measured[:80])).belief
        inside.append(abs(belief.mean[0] - 1.0) < 1.6449 * belief.sd[0])
    assert np.mean(inside) == pytest.approx(0.9, abs=0.07)  # 120 records: two and a half times 0.027


def test_tie_breaking_sensor_ranks_first():
    problem = compressor()
    at = np.array([AREA_M2, DIAMETER_M, BETA_RAD])
    candidates = [
        Candidate("a second flow meter", 0.005, lambda _x, theta, i: flow_kg_s(theta, i)[None]),
        Candidate("inlet velocity", 1.0, lambda _x, t, i: (0.5 * t[1] * SPEED_RAD_S[i] * np.tan(t[2]))[None]),
    ]
    gains = rank_sensors(problem, at, candidates)
    assert [g.name for g in gains] == ["inlet velocity", "a second flow meter"]
    assert gains[0].nats > gains[1].nats > 0.0
    # velocity gives the area: to the flow's and its own relative error, over forty samples
    assert gains[0].sd[0] / AREA_M2 < 0.01
    assert gains[1].sd[0] / AREA_M2 > 0.1


def test_sensor_gain_follows_log_determinant():
    """Without data or prior a parameter is known to its bounds' width, a held one exactly."""
    bounds = np.array([[0.0, 4.0], [-1.0, 9.0], [2.0, 2.0]])
    blank = Problem(("a", "b", "c"), bounds, Belief(np.zeros(3), np.diag([np.inf, 4.0, 0.5])), np.full((3, 1), np.nan),
                    np.ones(1), lambda _x, t, i: (t[0] + 0.0 * i)[None])  # fmt: skip
    first = Candidate("first", 0.5, lambda _x, t, i: (2.0 * t[0] + 0.0 * i)[None])
    second = Candidate("second", 2.0, lambda _x, t, i: (t[1] + 0.0 * i)[None])
    gains = rank_sensors(blank, np.array([1.0, 1.0, 2.0]), [second, first])
    assert [g.name for g in gains] == ["first", "second"]
    assert gains[0].nats == pytest.approx(0.5 * np.log(1.0 + 3.0 * 4.0 / 0.25 * 16.0))
    assert gains[1].nats == pytest.approx(0.5 * np.log(1.0 + 3.0 / 4.0 * 4.0))
    np.testing.assert_allclose(gains[1].sd, [4.0, 1.0, 0.0], atol=1e-12)
