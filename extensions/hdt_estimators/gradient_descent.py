"""Gradient descent with Barzilai and Borwein's step size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdt_core.estimation.conclude import CLOSE, conclude
from hdt_core.estimation.descent import Point, distance_to_optimum, quadratic_model
from hdt_core.estimation.estimate import Estimate, Status
from hdt_core.estimation.problem import Array, Problem

MEMORY = 8


@dataclass(frozen=True, slots=True)
class GradientDescent:
    """Descend the objective in coordinates scaled once at the start; halve steps that do not reduce it.

    Parameters
    ----------
    max_steps : int

    References
    ----------
    .. [1] M. Raydan, The Barzilai and Borwein gradient method for the large scale unconstrained minimization problem,
       SIAM J. Optim. 7(1), 1997: the objective may rise for a step, but not above the worst of the last few.
    """

    name: str = "gradient_descent"
    max_steps: int = 500

    def estimate(self, problem: Problem) -> Estimate:
        """Return the lowest point reached; covariance from the information at that point."""
        first = float(problem.objective(problem.origin[None])[0])
        if not np.isfinite(first):
            return conclude(problem, problem.origin * np.nan, "diverged", 1, method=self.name)
        at = quadratic_model(problem, problem.origin, 1)
        history = [first]
        step = 1.0
        scale, lowest = _scale(at), at  # scaled once, at the start
        status: Status = "max_steps"
        for _ in range(self.max_steps):
            if distance_to_optimum(at, problem.bounds) < 0.5 * CLOSE:
                status = "converged"
                break
            move, objective, n_tries = _descend(
                problem, at.theta, at.gradient, scale, step=step, ceiling=max(history[-MEMORY:])
            )
            later = quadratic_model(problem, at.theta + move, at.n_evals + n_tries)
            curvature = float(move @ (later.gradient - at.gradient))
            step = float(np.clip((move / scale) @ (move / scale) / curvature, 1e-6, 1e6)) if curvature > 0.0 else 1.0
            at = later
            lowest = at if at.objective <= lowest.objective else lowest
            history.append(objective)
        best = at if status == "converged" else lowest
        return conclude(problem, best.theta, status, at.n_evals, point=best, method=self.name)


def _descend(
    problem: Problem, theta: Array, gradient: Array, scale: Array, *, step: float, ceiling: float
) -> tuple[Array, float, int]:
    """Move (n,) down the scaled gradient inside the bounds, halved until below `ceiling`; its objective; tries."""
    lower, upper = problem.bounds.T
    for n_tries in range(1, 60):
        move = np.clip(theta - step * scale**2 * gradient, lower, upper) - theta
        objective = float(problem.objective((theta + move)[None])[0])
        if objective <= ceiling + 1e-4 * float(move @ gradient):
            return move, objective, n_tries
        step *= 0.5
    return np.zeros_like(theta), float(problem.objective(theta[None])[0]), n_tries + 1


def _scale(at: Point) -> Array:
    """Return each parameter's conditional standard deviation given all others, (n,)."""
    curvature = at.normal.diagonal()
    return np.asarray(1.0 / np.sqrt(np.where(curvature > 0.0, curvature, 1.0)))
