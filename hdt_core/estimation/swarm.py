"""A constrained particle swarm, and the box global methods search in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdt_core.estimation.problem import Array, Problem


@dataclass(frozen=True, slots=True)
class Swarm:
    """Where a swarm ended: best point (n,), its objective, passes over the record."""

    best: Array
    objective: float
    n_evals: int


def search_box(problem: Problem) -> tuple[Array, Array]:
    """Lower and upper corner (n,) of the box to search: the bounds; where there are none, four standard deviations
    of the prior; where nothing is known, ten times the starting value or ten about zero.
    """
    mean, sd = problem.origin, problem.prior.sd
    reach = np.where(np.isfinite(sd), 4.0 * sd, 10.0 * np.maximum(np.abs(mean), 1.0))
    lower, upper = problem.bounds.T
    return np.where(np.isfinite(lower), lower, mean - reach), np.where(np.isfinite(upper), upper, mean + reach)


def swarm_search(
    problem: Problem,
    rng: np.random.Generator,
    *,
    n_particles: int,
    n_iterations: int,
    inertia: float = 0.7298,
    cognitive: float = 1.49618,
    social: float = 1.49618,
) -> Swarm:
    """Minimise the problem's objective over its box; the starting point is one of the particles.

    A particle that would leave the box stops at the wall and loses its speed towards it.

    References
    ----------
    .. [1] M. Clerc and J. Kennedy, The particle swarm: explosion, stability and convergence, IEEE TEC 6(1), 2002:
       the defaults of inertia and pull.
    """
    lower, upper = search_box(problem)
    shape = (n_particles, lower.size)
    at = lower + (upper - lower) * rng.random(shape)
    at[0] = problem.origin
    speed = 0.1 * (upper - lower) * (2.0 * rng.random(shape) - 1.0)
    best_at, best_objective = at.copy(), problem.objective(at)
    for _ in range(n_iterations):
        pull = rng.random((2, *shape))
        leader = best_at[best_objective.argmin()]
        speed = inertia * speed + cognitive * pull[0] * (best_at - at) + social * pull[1] * (leader - at)
        free = at + speed
        at = np.minimum(np.maximum(free, lower), upper)
        speed[free != at] = 0.0
        objective = problem.objective(at)
        better = objective < best_objective
        best_at[better], best_objective[better] = at[better], objective[better]
    best = int(best_objective.argmin())
    return Swarm(best_at[best], float(best_objective[best]), n_particles * (n_iterations + 1))
