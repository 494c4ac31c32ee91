"""Particle swarm optimisation: a global search within bounds, with the paper's 30 particles and 100 iterations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdt_core.estimation.conclude import conclude, settle
from hdt_core.estimation.estimate import Estimate
from hdt_core.estimation.problem import Problem
from hdt_core.estimation.swarm import swarm_search


@dataclass(frozen=True, slots=True)
class ParticleSwarm:
    """Best point of a particle swarm; with `polish`, which is the default, least squares from there.

    Parameters
    ----------
    n_particles, n_iterations : int
    inertia, cognitive, social : float
        Clerc and Kennedy's constants.
    polish : bool
        Finish with Levenberg and Marquardt.
    seed : int
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
        swarm = swarm_search(
            problem,
            np.random.default_rng(self.seed),
            n_particles=self.n_particles,
            n_iterations=self.n_iterations,
            inertia=self.inertia,
            cognitive=self.cognitive,
            social=self.social,
        )
        if not np.isfinite(swarm.objective):
            return conclude(problem, swarm.best * np.nan, "diverged", swarm.n_evals, method=self.name)
        if self.polish:
            return settle(problem, swarm.best, swarm.n_evals, method=self.name)
        return conclude(problem, swarm.best, "max_steps", swarm.n_evals, method=self.name)
