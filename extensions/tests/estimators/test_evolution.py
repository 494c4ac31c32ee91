"""Populations that evolve."""

import numpy as np
import pytest

from hdt_core.estimation import Belief, Problem
from hdt_core.loading import UserError
from hdt_estimators import Genetic, evolution


def test_missing_deap_names_the_extra(monkeypatch):
    monkeypatch.setattr(evolution, "find_spec", lambda _name: None)
    problem = Problem(
        names=("level",),
        bounds=np.array([[0.0, 2.0]]),
        prior=Belief(np.ones(1), np.eye(1)),
        measured=np.ones((3, 1)),
        sigma=np.array([0.1]),
        observe=lambda _x, theta, i: theta[0] + 0.0 * np.asarray(i)[None],
    )

    with pytest.raises(UserError, match=r"hybrid-digital-twin-extensions\[genetic\]"):
        Genetic().estimate(problem)
