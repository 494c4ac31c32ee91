"""Descent of Levenberg and Marquardt inside bounds, and the distance of a point from the optimum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from hdt_core.estimation.damped import FIRST_DAMPING, MOST_DAMPING, damped_step, is_exhausted, is_settled, next_damping
from hdt_core.estimation.identifiability import SINGULAR
from hdt_core.estimation.problem import Array, Problem


@dataclass(frozen=True, slots=True)
class Point:
    """Quadratic model of the objective about a point, and its cost.

    Parameters
    ----------
    theta : array (n,)
    objective : float
        Twice the negative log posterior; infinite where the model fails.
    gradient : array (n,)
        Half the objective's gradient, J^T r with the prior's part.
    normal : array (n, n)
        J^T J with the prior's information.
    n_evals : int
        Passes over the record.
    """

    theta: Array
    objective: float
    gradient: Array
    normal: Array
    n_evals: int = 0


def quadratic_model(problem: Problem, theta: Array, n_evals: int = 0) -> Point:
    """Compute the objective and its quadratic model about `theta` (n,), after `n_evals` passes."""
    residual, slope = problem.residual(theta).ravel(), problem.sensitivity(theta)
    deviation, information = theta - problem.prior.mean, problem.prior.information
    with np.errstate(over="ignore", invalid="ignore"):
        cost = float(residual @ residual + deviation @ information @ deviation)
        gradient, normal = slope.T @ residual + information @ deviation, slope.T @ slope + information
    return Point(theta, cost, gradient, normal, n_evals + 1 + 2 * theta.size)


def descend(problem: Problem, origin: Array, max_steps: int = 200, n_evals: int = 0) -> Point:
    """Minimise the objective from `origin` (n,); return the point reached, with derivatives of the last step.

    Where the model fails at `origin`, it stays there and its objective is infinite.
    """
    lower, upper = problem.bounds[:, 0], problem.bounds[:, 1]
    cost = float(problem.objective(origin[None])[0])
    if not np.isfinite(cost):
        n = origin.size
        return Point(origin, np.inf, np.full(n, np.nan), np.full((n, n), np.nan), n_evals + 1)
    point = quadratic_model(problem, origin, n_evals)
    evals, size = point.n_evals, np.full(origin.size, np.finfo(float).tiny)
    damping, growth = FIRST_DAMPING, 2.0
    for _ in range(max_steps):
        size = np.maximum(size, np.sqrt(np.diag(point.normal)))
        step, predicted_reduction = damped_step(point.normal, point.gradient, size, damping, point.theta, lower, upper)
        trial = point.theta + step
        if is_settled(predicted_reduction, point.objective, max(problem.n_values, 1)):
            return Point(trial, point.objective, point.gradient, point.normal, evals)
        reduction = point.objective - float(problem.objective(trial[None])[0])
        evals += 1
        damping, growth = next_damping(damping, growth, reduction, predicted_reduction)
        if reduction > 0.0:
            point = quadratic_model(problem, trial, evals)
            evals = point.n_evals
        if is_exhausted(predicted_reduction, reduction, point.objective) or damping > MOST_DAMPING:
            break
    return Point(point.theta, point.objective, point.gradient, point.normal, evals)


def distance_to_optimum(point: Point, bounds: Array) -> float:
    r"""Compute the distance to the quadratic model's optimum in standard deviations: Newton's decrement.

    .. math:: \sqrt{g^T (J^T J + P_0^{-1})^{-1} g}

    over the parameters that are neither fixed nor held by a bound; with the bounds kept where the plain step
    would leave them. No parameter is further from that optimum than this many of its standard deviations.

    References
    ----------
    .. [1] S. Boyd and L. Vandenberghe, Convex Optimization, 2004, section 9.5.
    """
    lower, upper = bounds.T
    at_lower, at_upper = point.theta <= lower, point.theta >= upper
    is_held = (at_lower & (point.gradient >= 0.0)) | (at_upper & (point.gradient <= 0.0))
    free = (lower < upper) & ~is_held
    if not free.any():
        return 0.0
    gradient, normal = point.gradient[free], point.normal[np.ix_(free, free)]
    if not (np.isfinite(gradient).all() and np.isfinite(normal).all()):
        return float("inf")
    size = np.sqrt(np.maximum(normal.diagonal(), 0.0))
    size[size == 0.0] = 1.0
    values, vectors = np.linalg.eigh(normal / np.outer(size, size))
    observable = values > values[-1] / SINGULAR
    along = vectors[:, observable].T @ (gradient / size) / np.sqrt(values[observable])
    step = -(vectors[:, observable] @ (along / np.sqrt(values[observable]))) / size
    is_inside = (point.theta[free] + step >= lower[free]) & (point.theta[free] + step <= upper[free])
    if is_inside.all():
        return float(np.linalg.norm(along))
    root = np.sqrt(values[observable])[:, None] * vectors[:, observable].T
    room = np.column_stack([lower, upper])[free] - point.theta[free, None]
    method = "bvls" if observable.all() else "trf"
    scaled_step = lsq_linear(root, -along, bounds=(room * size[:, None]).T, method=method).x
    predicted_reduction = -2.0 * float(gradient / size @ scaled_step) - float(np.sum((root @ scaled_step) ** 2))
    return float(np.sqrt(max(predicted_reduction, 0.0)))
