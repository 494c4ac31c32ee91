"""Populations that evolve: differential evolution by SciPy, a genetic algorithm by DEAP (the extra `genetic`)."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
import numpy.typing as npt
from scipy.optimize import differential_evolution

from hdt_core.estimation.conclude import conclude, settle
from hdt_core.estimation.estimate import Estimate
from hdt_core.estimation.problem import Array, Problem
from hdt_core.loading import UserError

NO_ANSWER = 1e150  # fitness of an individual the model has no answer for
Mask = npt.NDArray[np.bool_]
Fittest = tuple[Array, float, int, bool]
"""The fittest individual (free parameters,), its objective, evaluations, and whether the population agreed."""
Search = Callable[[Problem, Mask, Array, Array], Fittest]


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
        return evolve(problem, self._search, self.name, polish=self.polish)

    def _search(self, problem: Problem, free: Mask, lower: Array, upper: Array) -> Fittest:
        result = differential_evolution(
            lambda columns: fitness(problem, free, columns.T),
            np.column_stack([lower, upper]),
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
        return result.x, result.fun, self.population * lower.size * (result.nit + 1), result.success


def evolve(problem: Problem, search: Search, method: str, *, polish: bool) -> Estimate:
    """Search the box of the free parameters; with `polish`, finish the fittest individual by least squares."""
    lower, upper = problem.search_box
    free = upper > lower
    theta = problem.origin.copy()
    if not free.any():
        return settle(problem, theta, 0, method=method)
    theta[free], objective, n_evals, has_converged = search(problem, free, lower[free], upper[free])
    if objective >= NO_ANSWER:
        return conclude(problem, theta * np.nan, "diverged", n_evals, method=method)
    if polish:
        return settle(problem, theta, n_evals, method=method)
    return conclude(problem, theta, "converged" if has_converged else "max_steps", n_evals, method=method)


def fitness(problem: Problem, free: Mask, rows: Array) -> Array:
    """Return the finite objective (p,) of individuals (p, free parameters), fixed parameters inserted."""
    thetas = np.repeat(problem.origin[None], len(rows), axis=0)
    thetas[:, free] = rows
    return np.minimum(problem.objective(thetas), NO_ANSWER)


CROWDING = 15.0  # of crossover and mutation: larger keeps children closer to their parents


@dataclass(frozen=True, slots=True)
class Genetic:
    """Tournaments choose parents, simulated binary crossover and polynomial mutation make children, the best one stays.

    With `polish`, the default, least squares from the fittest.

    Parameters
    ----------
    population : int
        Individuals per parameter.
    max_generations : int
    agreement : float
        Spread of the population's objectives at which evolution ends.
    crossover, mutation : float
        Probability of a pair, and of an individual.
    polish : bool
    seed : int

    Raises
    ------
    UserError
        From `estimate`, where DEAP is not installed.

    References
    ----------
    .. [1] K. Deb and R. B. Agrawal, Simulated binary crossover for continuous search space, Complex Systems 9, 1995.
    .. [2] F.-A. Fortin et al., DEAP: evolutionary algorithms made easy, JMLR 13, 2012.
    """

    name: str = "genetic"
    population: int = 15
    max_generations: int = 300
    agreement: float = 1e-6
    polish: bool = True
    crossover: float = 0.9
    mutation: float = 0.3
    seed: int = 0

    def estimate(self, problem: Problem) -> Estimate:
        """Return the fittest individual; covariance from the information at that point."""
        if find_spec("deap") is None:
            raise UserError("genetic needs DEAP: pip install 'hybrid-digital-twin-extensions[genetic]'")
        return evolve(problem, self._search, self.name, polish=self.polish)

    def _search(self, problem: Problem, free: Mask, lower: Array, upper: Array) -> Fittest:
        before = random.getstate()  # DEAP draws from the module's generator
        random.seed(self.seed)
        try:
            return self._evolve(problem, free, lower, upper)
        finally:
            random.setstate(before)

    def _evolve(self, problem: Problem, free: Mask, lower: Array, upper: Array) -> Fittest:
        from deap import algorithms, base, tools

        class Fitness(base.Fitness):  # type: ignore[misc]
            weights = (-1.0,)

        class Individual(list):  # type: ignore[type-arg]
            def __init__(self, genes: Array) -> None:
                super().__init__(genes.tolist())
                self.fitness = Fitness()

        limits = {"eta": CROWDING, "low": lower.tolist(), "up": upper.tolist()}
        toolbox = base.Toolbox()
        n_evals = 0
        toolbox.register("mate", tools.cxSimulatedBinaryBounded, **limits)
        toolbox.register("mutate", tools.mutPolynomialBounded, indpb=1.0 / lower.size, **limits)
        n = self.population * lower.size + (self.population * lower.size) % 2
        genes = lower + (upper - lower) * np.random.default_rng(self.seed).random((n, lower.size))
        genes[0] = problem.origin[free]
        population = [Individual(row) for row in genes]
        for generation in range(self.max_generations + 1):
            if generation:
                champion = tools.selBest(population, 1)
                parents = tools.selTournament(population, n - 1, tournsize=3)
                population = champion + algorithms.varAnd(parents, toolbox, self.crossover, self.mutation)
            new = [individual for individual in population if not individual.fitness.valid]
            objectives = fitness(problem, free, np.array(new, float).reshape(len(new), lower.size))
            for individual, objective in zip(new, objectives.tolist(), strict=True):
                individual.fitness.values = (objective,)
            n_evals += len(new)
            values = [individual.fitness.values[0] for individual in population]
            if max(values) - min(values) < self.agreement:
                break
        best = int(np.argmin(values))
        return np.array(population[best]), values[best], n_evals, max(values) - min(values) < self.agreement
