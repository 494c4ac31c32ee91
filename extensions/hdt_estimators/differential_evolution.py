"""Differential evolution: a population that moves by the differences of its members; SciPy is the engine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import differential_evolution

from hdt_core.estimation.conclude import conclude, settle
from hdt_core.estimation.estimate import Estimate
from hdt_core.estimation.problem import Array, Problem

NO_ANSWER = 1e150  # fitness of an individual the model has no answer for


@dataclass(frozen=True, slots=True)
class DifferentialEvolution:
    """Evolve a population over the box until its objectives agree; with `polish`, least squares from the best.

    Parameters
    ----------
    population : int
        Individuals per parameter.
    max_generations : int
    agreement : float
        Spread of the population's objectives at which evolution ends; 1e-6 is a thousandth of a standard deviation.
    polish : bool
    seed : int

    References
    ----------
    .. [1] R. Storn and K. Price, Differential evolution, J. Global Optim. 11, 1997.
    """

    name: str = "differential_evolution"
    population: int = 15
    max_generations: int = 300
    agreement: float = 1e-6
    polish: bool = True
    seed: int = 0

    def estimate(self, problem: Problem) -> Estimate:
        """Return the fittest individual; covariance from the information at that point."""
        lower, upper = problem.search_box
        free = upper > lower
        if not free.any():
            return settle(problem, problem.origin, 0, method=self.name)
        result = differential_evolution(
            lambda columns: fitness(problem, free, columns.T),
            np.column_stack([lower, upper])[free],
            x0=problem.origin[free],
            popsize=self.population,
            maxiter=self.max_generations,
            tol=0.0,
            atol=self.agreement,
            polish=False,
            updating="deferred",
            vectorized=True,
            rng=np.random.default_rng(self.seed),
        )
        theta = problem.origin.copy()
        theta[free] = result.x
        n_evals = self.population * int(free.sum()) * (result.nit + 1)
        if result.fun >= NO_ANSWER:
            return conclude(problem, theta * np.nan, "diverged", n_evals, method=self.name)
        if self.polish:
            return settle(problem, theta, n_evals, method=self.name)
        return conclude(problem, theta, "converged" if result.success else "max_steps", n_evals, method=self.name)


def fitness(problem: Problem, free: npt.NDArray[np.bool_], rows: Array) -> Array:
    """Return the finite objective (p,) of individuals (p, free parameters), fixed parameters inserted."""
    thetas = np.repeat(problem.origin[None], len(rows), axis=0)
    thetas[:, free] = rows
    return np.minimum(problem.objective(thetas), NO_ANSWER)
