"""Gradient descent with Barzilai and Borwein's step: the slowest road to the least squares, and the simplest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdt_core.estimation.estimate import Estimate, Status, conclude
from hdt_core.estimation.problem import Array, Problem

SETTLED = 1e-8  # share of the residual variance the next step could win, as in least squares
MEMORY = 8


@dataclass(frozen=True, slots=True)
class GradientDescent:
    """Descend the objective in coordinates scaled once, at the start; steps that do not pay are halved.

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
        """Lowest point reached; covariance from the information at that point."""
        lower, upper = problem.bounds.T
        theta = problem.origin
        history = [float(problem.objective(theta[None])[0])]
        if not np.isfinite(history[0]):
            return conclude(problem, theta * np.nan, "diverged", 1)
        gradient, scale = _gradient(problem, theta)
        step, n_evals = 1.0, 2 * theta.size + 2
        reached: Status = "max_steps"
        for _ in range(self.max_steps):
            move, objective, tried = _descend(
                problem, theta, gradient, scale, step=step, ceiling=max(history[-MEMORY:])
            )
            n_evals += tried
            later, (gradient_later, scale_now) = theta + move, _gradient(problem, theta + move)
            n_evals += 2 * theta.size + 1
            change = gradient_later - gradient
            curved = float(move @ change)
            step = float(np.clip((move / scale) @ (move / scale) / curved, 1e-6, 1e6)) if curved > 0.0 else 1.0
            theta, gradient = later, gradient_later
            history.append(objective)
            inward = np.clip(theta - scale_now**2 * gradient, lower, upper) - theta
            if -float(inward @ gradient) <= max(SETTLED * objective / max(problem.n_values, 1), 1e-22):
                reached = "converged"
                break
        return conclude(problem, theta, reached, n_evals)


def _descend(
    problem: Problem, theta: Array, gradient: Array, scale: Array, *, step: float, ceiling: float
) -> tuple[Array, float, int]:
    """Move (n,) down the scaled gradient inside the bounds, halved until below `ceiling`; its objective; tries."""
    lower, upper = problem.bounds.T
    for tried in range(1, 60):
        move = np.clip(theta - step * scale**2 * gradient, lower, upper) - theta
        objective = float(problem.objective((theta + move)[None])[0])
        if objective <= ceiling + 1e-4 * float(move @ gradient):
            return move, objective, tried
        step *= 0.5
    return np.zeros_like(theta), float(problem.objective(theta[None])[0]), tried + 1


def _gradient(problem: Problem, theta: Array) -> tuple[Array, Array]:
    """Half the gradient of the objective, (n,), and every parameter's standard deviation if all others were known."""
    residual, slope = problem.residual(theta).ravel(), problem.sensitivity(theta)
    belief = problem.prior.information
    curvature = np.einsum("ij,ij->j", slope, slope) + np.diag(belief)
    scale = 1.0 / np.sqrt(np.where(curvature > 0.0, curvature, 1.0))
    return slope.T @ residual + belief @ (theta - problem.prior.mean), scale
