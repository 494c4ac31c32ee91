"""Gains of further sensors, whose answers are known in closed form."""

import numpy as np
import pytest
from compressor_problem import AREA_M2, BETA_RAD, DIAMETER_M, SPEED_RAD_S, compressor, flow_kg_s

from hdt_core.estimation import Belief, Problem
from hdt_estimators.experiment import Candidate, rank_sensors


def test_the_sensor_that_breaks_the_tie_is_ranked_first():
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


def test_a_sensor_brings_half_the_growth_of_the_log_determinant():
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
