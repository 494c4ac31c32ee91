"""Differential evolution, the genetic algorithm for real numbers; SciPy is the engine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import differential_evolution

from hdt_core.estimation.estimate import Estimate, conclude
from hdt_core.estimation.problem import Problem
from hdt_core.estimation.swarm import search_box

NO_ANSWER = 1e150  # fitness of an individual the model has no answer for


@dataclass(frozen=True, slots=True)
class Genetic:
    """Evolve a population over the box until its objectives agree.

    Parameters
    ----------
    population : int
        Individuals per parameter.
    max_generations : int
    agreement : float
        Spread of the population's objectives at which evolution ends; 1e-6 is a thousandth of a standard deviation.
    seed : int
    """

    name: str = "genetic"
    population: int = 15
    max_generations: int = 300
    agreement: float = 1e-6
    seed: int = 0

    def estimate(self, problem: Problem) -> Estimate:
        """Fittest individual; covariance from the information at that point."""
        lower, upper = search_box(problem)
        free = upper > lower
        if not free.any():
            return conclude(problem, problem.origin, "converged", 0)

        def fitness(columns: np.ndarray) -> np.ndarray:
            rows = np.repeat(problem.origin[None], columns.shape[1], axis=0)
            rows[:, free] = columns.T
            return np.minimum(problem.objective(rows), NO_ANSWER)

        result = differential_evolution(
            fitness,
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
            return conclude(problem, theta * np.nan, "diverged", n_evals)
        return conclude(problem, theta, "converged" if result.success else "max_steps", n_evals)
