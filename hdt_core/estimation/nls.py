"""Nonlinear least squares: Levenberg and Marquardt's method with bounds, the method of the paper's calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdt_core.estimation.estimate import Estimate, Status, conclude
from hdt_core.estimation.kernels.damped import FIRST_DAMPING, MOST_DAMPING, damped_step, is_settled, next_damping
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
        """Point of least squares; covariance from the information at that point."""
        if problem.kernels is not None and problem.kernels.least_squares is not None:
            theta, information, n_evals, settled = problem.kernels.least_squares(
                problem.origin,
                problem.bounds[:, 0],
                problem.bounds[:, 1],
                problem.prior.mean,
                problem.prior.information,
                self.max_steps,
            )
            return conclude(problem, theta, "converged" if settled else "max_steps", n_evals, information=information)
        return polish(problem, problem.origin, self.max_steps)


def polish(problem: Problem, origin: Array, max_steps: int = 200, n_evals: int = 0) -> Estimate:
    """Least squares from `origin` (n,) instead of the prior's mean: the last mile of a global search."""
    theta = origin
    lower, upper = problem.bounds[:, 0], problem.bounds[:, 1]
    belief = problem.prior.information
    cost = float(problem.objective(theta[None])[0])
    if not np.isfinite(cost):
        return conclude(problem, np.full(theta.size, np.nan), "diverged", n_evals + 1)
    cost, gradient, normal = _linearised(problem, theta, belief)
    n_evals += 1 + 2 * theta.size
    size = np.full(theta.size, np.finfo(float).tiny)
    damping, growth, settled = FIRST_DAMPING, 2.0, False
    for _ in range(max_steps):
        size = np.maximum(size, np.sqrt(np.diag(normal)))
        step, promised = damped_step(normal, gradient, size, damping, theta, lower, upper)
        trial = theta + step
        won = cost - float(problem.objective(trial[None])[0])
        n_evals += 1
        settled = bool(is_settled(promised, won, cost, max(problem.n_values, 1)))
        damping, growth = next_damping(damping, growth, won, promised)
        if won > 0.0:
            theta = trial
            cost, gradient, normal = _linearised(problem, theta, belief)
            n_evals += 1 + 2 * theta.size
        if settled or damping > MOST_DAMPING:
            break
    reached: Status = "converged" if settled else "max_steps"
    return conclude(problem, theta, reached, n_evals, information=normal - belief)


def _linearised(problem: Problem, theta: Array, belief: Array) -> tuple[float, Array, Array]:
    residual = problem.residual(theta).ravel()
    slope = problem.sensitivity(theta)
    away = theta - problem.prior.mean
    cost = float(residual @ residual + away @ belief @ away)
    return cost, slope.T @ residual + belief @ away, slope.T @ slope + belief
