"""Methods that minimise the objective: nonlinear least squares, the method of the paper's calibration, and a particle
swarm within bounds, with the paper's 30 particles and 100 iterations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdt_core.estimation.conclude import conclude, conclude_at, conclude_each, settle
from hdt_core.estimation.descent import descend_each, descend_from_start
from hdt_core.estimation.estimate import Estimate
from hdt_core.estimation.problem import Array, Problem


@dataclass(frozen=True, slots=True)
class NonlinearLeastSquares:
    """Minimum of the weighted sum of squares plus the prior's term, from the prior's mean, inside the bounds.

    Parameters
    ----------
    max_steps : int
        Steps tried, taken or not; the paper's 200.
    """

    name: str = "nls"
    max_steps: int = 200

    def estimate(self, problem: Problem) -> Estimate:
        """Minimise the sum of squares; covariance from the information at that point."""
        return conclude_at(problem, descend_from_start(problem, self.max_steps), method=self.name)

    def estimate_each(self, problem: Problem) -> list[Estimate]:
        """Estimate each problem of a batch, all side by side."""
        origin = np.tile(problem.origin, (problem.n_problems, 1))
        return conclude_each(problem, descend_each(problem, origin, self.max_steps), method=self.name)


@dataclass(frozen=True, slots=True)
class Swarm:
    """Result of a search: best point (n,), its objective, passes over the record."""

    best: Array
    objective: float
    n_evals: int


@dataclass(frozen=True, slots=True)
class ParticleSwarm:
    """Best point of a particle swarm; with `polish`, which is the default, least squares from there.

    Parameters
    ----------
    inertia, cognitive, social : float
        Clerc and Kennedy's constants.
    polish : bool
        Finish with Levenberg and Marquardt.
    """

    name: str = "pso"
    n_particles: int = 30
    n_iterations: int = 100
    inertia: float = 0.7298
    cognitive: float = 1.49618
    social: float = 1.49618
    polish: bool = True
    seed: int = 0

    def estimate(self, problem: Problem) -> Estimate:
        """Minimise the objective; covariance from the information at that point."""
        swarm = self.search(problem)
        if not np.isfinite(swarm.objective):
            return conclude(problem, swarm.best * np.nan, "diverged", swarm.n_evals, method=self.name)
        if self.polish:
            return settle(problem, swarm.best, swarm.n_evals, method=self.name)
        return conclude(problem, swarm.best, "max_steps", swarm.n_evals, method=self.name)

    def search(self, problem: Problem) -> Swarm:
        """Minimise the problem's objective over its box; the starting point is one of the particles.

        A particle that would leave the box stops at the wall and loses its speed towards it.

        References
        ----------
        .. [1] M. Clerc and J. Kennedy, The particle swarm: explosion, stability and convergence, IEEE TEC 6(1), 2002:
           the defaults of inertia and pull.
        """
        lower, upper = problem.search_box
        rng = np.random.default_rng(self.seed)
        shape = (self.n_particles, lower.size)
        theta = lower + (upper - lower) * rng.random(shape)
        theta[0] = problem.origin
        velocity = 0.1 * (upper - lower) * (2.0 * rng.random(shape) - 1.0)
        best_theta = theta.copy()
        best_objective = problem.objective(theta)
        for _ in range(self.n_iterations):
            pull = rng.random((2, *shape))
            leader = best_theta[best_objective.argmin()]
            velocity = self.inertia * velocity + self.cognitive * pull[0] * (best_theta - theta)
            velocity += self.social * pull[1] * (leader - theta)
            target = theta + velocity
            theta = np.minimum(np.maximum(target, lower), upper)
            velocity[target != theta] = 0.0
            objective = problem.objective(theta)
            is_better = objective < best_objective
            best_theta[is_better], best_objective[is_better] = theta[is_better], objective[is_better]
        best = int(best_objective.argmin())
        return Swarm(best_theta[best], float(best_objective[best]), self.n_particles * (self.n_iterations + 1))
