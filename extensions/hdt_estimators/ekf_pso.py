"""Extended Kalman filter with a constrained particle swarm: the swarm finds where to take the tangents."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdt_core.estimation.conclude import conclude
from hdt_core.estimation.estimate import Estimate
from hdt_core.estimation.kalman import recursive_estimate, trajectory
from hdt_core.estimation.kalman_step import tangent
from hdt_core.estimation.optimisers import ParticleSwarm
from hdt_core.estimation.problem import Problem


@dataclass(frozen=True, slots=True)
class SwarmKalman:
    """Filter about the trajectory of the best particle, after Sun et al. (2018), cited by the paper.

    The swarm keeps the physical bounds and does not mind a wrong guess; the filter gives the uncertainty. The prior
    stays what it was: the swarm moves the point of linearisation only, so no sample counts twice.

    Parameters
    ----------
    n_particles, n_iterations : int
        A short search: the filter does the rest.
    smoother_passes : int
    seed : int
    """

    name: str = "ekf_pso"
    n_particles: int = 20
    n_iterations: int = 30
    smoother_passes: int = 20
    seed: int = 0

    def estimate(self, problem: Problem) -> Estimate:
        """Return the belief after the last sample, linearised about the best particle's trajectory."""
        swarm = ParticleSwarm(n_particles=self.n_particles, n_iterations=self.n_iterations, seed=self.seed).search(
            problem
        )
        if not np.isfinite(swarm.objective):
            return conclude(problem, swarm.best * np.nan, "diverged", swarm.n_evals, method=self.name)
        about = trajectory(problem, swarm.best)
        return recursive_estimate(
            problem, tangent, self.smoother_passes, method=self.name, about=about, n_evals=swarm.n_evals
        )
