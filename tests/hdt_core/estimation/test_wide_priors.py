"""A filter that has learned nothing from its sigma points does not report the deviation that it began with."""

from dataclasses import replace

import numpy as np
import pytest

from hdt_core.estimation import Belief, NonlinearLeastSquares, Problem, UnscentedKalman

TIME_S = np.linspace(0.0, 6.0, 80)
LOW = 1.0
HIGH = 1e6


def saturating() -> Problem:
    """A level that approaches 1 with its conductance, of which nothing is known but the bounds."""
    noise = 0.01 * np.random.default_rng(0).standard_normal(TIME_S.size)
    return Problem(
        names=("conductance",),
        bounds=np.array([[LOW, HIGH]]),
        prior=Belief(np.array([2500.0]), np.array([[(HIGH - LOW) ** 2 / 12.0]])),
        measured=(1500.0 / (1500.0 + 400.0 * (1.0 + TIME_S)) + noise)[:, None],
        sigma=np.array([0.01]),
        observe=lambda _x, theta, i: (theta[0] / (theta[0] + 400.0 * (1.0 + TIME_S[i])))[None],
    )


def test_polished_filter_states_data_deviation():
    problem = saturating()

    estimate = UnscentedKalman().estimate(problem)

    assert estimate.status == "converged"
    assert estimate.belief.sd == pytest.approx(NonlinearLeastSquares().estimate(problem).belief.sd, rel=0.01)


def test_drifting_parameter_keeps_filter_deviation():
    still = saturating()
    drifting = replace(still, prior=Belief(np.array([1500.0]), np.array([[100.0]])), drift=np.array([100.0]))

    estimate = UnscentedKalman().estimate(drifting)

    assert estimate.belief.sd[0] == pytest.approx(estimate.path_sd[-1, 0], rel=0.1)
