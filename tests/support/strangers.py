"""A method of another package, found by the name of its entry point."""

from importlib.metadata import EntryPoint
from types import SimpleNamespace

import numpy as np
import pytest

from hdt_core import loading
from hdt_core.estimation import Belief, Estimate, Problem, estimators
from hdt_core.estimation.fit import Identifiability

NAME = "newton"


class Newton:
    """Ten plain Gauss-Newton steps from the prior's mean."""

    name = NAME

    def estimate(self, problem: Problem) -> Estimate:
        """Return the last step's point with the inverse of its information."""
        theta = problem.origin
        for _ in range(10):
            slope = problem.sensitivity(theta)
            information = slope.T @ slope + problem.prior.information
            pull = slope.T @ problem.residual(theta).ravel() + problem.prior.information @ (theta - problem.prior.mean)
            theta = np.clip(theta - np.linalg.solve(information, pull), *problem.bounds.T)
        cov = np.linalg.inv(information)
        return Estimate(Belief(theta, cov), "converged", 10, Identifiability(problem.names, slope.T @ slope))


class Lost:
    """A method that gives up on every problem, in one of the ways there are."""

    def __init__(self, status: str, mean: float = 0.0) -> None:
        self.name = NAME
        self.status = status
        self.mean = mean

    def estimate(self, problem: Problem) -> Estimate:
        """Return no estimate."""
        n = len(problem.names)
        belief = Belief(np.full(n, self.mean), np.eye(n))
        return Estimate(belief, self.status, 1, Identifiability(problem.names, np.eye(n)))  # type: ignore[arg-type]


def install_method(monkeypatch: pytest.MonkeyPatch, method: object) -> None:
    """Have a package bring a method, until the test ends."""
    entry = SimpleNamespace(name=NAME, value=f"other:{NAME}", dist=None, load=lambda: method)

    def list_entries(group: str) -> list[EntryPoint | SimpleNamespace]:
        return [entry] if group == "hdt.estimators" else []

    monkeypatch.setattr(loading, "entry_points", list_entries)
    estimators.cache_clear()


def forget_methods() -> None:
    """Look for the methods of packages anew."""
    estimators.cache_clear()
