"""Descent of Levenberg and Marquardt inside bounds, and the distance of a point from the optimum."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hdt_core.estimation.compiled import (
    FIRST_DAMPING,
    MOST_DAMPING,
    damped_step,
    is_exhausted,
    is_settled,
    next_damping,
)
from hdt_core.estimation.fit import scaled_eigen
from hdt_core.estimation.problem import Array, Problem

TINY = float(np.finfo(float).tiny)
Weigh = Callable[[Array], Array]


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
    cost, gradient, normal = linearise(problem, theta[None])
    return Point(theta, float(cost[0]), gradient[0], normal[0], n_evals + 1 + 2 * theta.size)


def linearise(problem: Problem, theta: Array, weigh: Weigh | None = None) -> tuple[Array, Array, Array]:
    """Compute the objective (b,), half its gradient (b, n) and the normal matrix (b, n, n) at `theta` (b, n); the
    objective is infinite where the model fails.

    `weigh` gives the weight of each residual (k, m), which is over its standard deviation.
    """
    residual, slope = problem.linearised_each(theta)
    slope = slope.reshape(*residual.shape, theta.shape[1])
    deviation = theta - problem.prior.mean
    information = problem.prior.information
    with np.errstate(over="ignore", invalid="ignore"):
        weighted = slope if weigh is None else weigh(residual)[..., None] * slope
        cost = problem.sum_each(np.einsum("km,km->k", residual, residual))
        gradient = problem.sum_each(np.einsum("kmi,km->ki", weighted, residual))
        normal = problem.sum_each(np.einsum("kmi,kmj->kij", weighted, slope))
        pull = deviation @ information
        cost = np.nan_to_num(cost + np.einsum("bi,bi->b", pull, deviation), nan=np.inf, posinf=np.inf)
    return cost, gradient + pull, normal + information


def gauss_newton(problem: Problem, origin: Array, steps: int, weigh: Weigh) -> tuple[Array, Array]:
    """Take reweighted steps of Gauss and Newton from `origin` (b, n): estimates (b, n), covariances (b, n, n)."""
    theta = origin
    for _ in range(steps):
        _, gradient, normal = linearise(problem, theta, weigh)
        cov = np.asarray(np.linalg.inv(normal), float)
        theta = np.clip(theta - np.einsum("bij,bj->bi", cov, gradient), *problem.bounds.T)
    return theta, cov


@dataclass(slots=True)
class _Walk:
    """Descent of one problem of a batch: the point reached, the trial beyond it, and the damping."""

    number: int
    point: Point
    n_values: int
    size: Array
    trial: Array
    damping: float = FIRST_DAMPING
    growth: float = 2.0
    predicted_reduction: float = 0.0
    is_better: bool = True
    goes_on: bool = True

    def propose(self, bounds: Array) -> None:
        """Compute the next trial; where it is the last, take it untried."""
        point, self.size = self.point, np.maximum(self.size, np.sqrt(np.diag(self.point.normal)))
        quadratic = (point.normal, point.gradient, self.size, self.damping, point.theta)
        step, self.predicted_reduction = damped_step(*quadratic, bounds[:, 0], bounds[:, 1])
        self.trial = point.theta + step
        if is_settled(self.predicted_reduction, point.objective, max(self.n_values, 1)):
            self.point, self.goes_on = replace(point, theta=self.trial), False

    def judge(self, objective: float) -> None:
        """Compare the trial's objective with the point's, and update the damping."""
        reduction = self.point.objective - objective
        before = self.point.objective
        self.point = replace(self.point, n_evals=self.point.n_evals + 1)
        self.damping, self.growth = next_damping(self.damping, self.growth, reduction, self.predicted_reduction)
        is_over = is_exhausted(self.predicted_reduction, reduction, before) or self.damping > MOST_DAMPING
        self.is_better = reduction > 0.0
        self.goes_on = not is_over


def descend(problem: Problem, origin: Array, max_steps: int = 200, n_evals: int = 0) -> Point:
    """Minimise the objective from `origin` (n,); return the point reached, with derivatives of the last step.

    Where the model fails at `origin`, it stays there and its objective is infinite.
    """
    return descend_each(problem, origin[None], max_steps, n_evals)[0]


def descend_from_start(problem: Problem, max_steps: int = 200) -> Point:
    """Minimise the objective from the prior's mean, by the problem's own kernel where it has one."""
    if problem.kernels is None or problem.kernels.least_squares is None:
        return descend(problem, problem.origin, max_steps)
    prior = problem.prior
    start = (problem.origin, *problem.bounds.T, prior.mean, prior.information)
    return Point(*problem.kernels.least_squares(*start, max_steps))


def descend_each(problem: Problem, origin: Array, max_steps: int = 200, n_evals: int = 0) -> list[Point]:
    """Minimise the objective of each problem of a batch, side by side, from its row of `origin` (b, n)."""
    n = origin.shape[1]
    nothing = np.full((origin.shape[1],) * 2, np.nan)
    n_values = problem.sum_each(np.count_nonzero(~np.isnan(problem.measured), axis=1)).tolist()
    walks = [
        _Walk(b, Point(theta, np.inf, nothing[0], nothing, n_evals), n_values[b], np.full(n, TINY), theta)
        for b, theta in enumerate(origin)
    ]
    _linearise_trials(problem, walks)
    live = [walk for walk in walks if walk.point.objective < np.inf]
    for _ in range(max_steps):
        for walk in live:
            walk.propose(problem.bounds)
        live = [walk for walk in live if walk.goes_on]
        if not live:
            break
        if problem.trajectory is None:
            _judge_trials(problem, live)
        else:
            _judge_models(problem, live[0])
        live = [walk for walk in live if walk.goes_on]
    return [walk.point for walk in walks]


def _judge_trials(problem: Problem, walks: list[_Walk]) -> None:
    """Compare objectives first, and compute derivatives where a trial is better."""
    part, trials = _trials(problem, walks)
    for walk, objective in zip(walks, part.objective_each(trials[None])[0], strict=True):
        walk.judge(float(objective))
    _linearise_trials(problem, [walk for walk in walks if walk.is_better])


def _judge_models(problem: Problem, walk: _Walk) -> None:
    """Compute objective and derivatives of a trial at once: columns of one integration cost hardly more than one."""
    trial = quadratic_model(problem, walk.trial, walk.point.n_evals)
    walk.judge(trial.objective)
    walk.point = trial if walk.is_better else replace(walk.point, n_evals=trial.n_evals)


def _linearise_trials(problem: Problem, walks: list[_Walk]) -> None:
    """Move walks to their trials, with the quadratic model there."""
    if walks:
        part, trials = _trials(problem, walks)
        for walk, *model in zip(walks, *linearise(part, trials), strict=True):
            spent = walk.point.n_evals + 1 + 2 * walk.trial.size
            walk.point = Point(walk.trial, float(model[0]), model[1], model[2], spent)


def _trials(problem: Problem, walks: list[_Walk]) -> tuple[Problem, Array]:
    return problem.select(np.array([walk.number for walk in walks])), np.array([walk.trial for walk in walks])


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
    at_lower = point.theta <= lower
    at_upper = point.theta >= upper
    is_held = (at_lower & (point.gradient >= 0.0)) | (at_upper & (point.gradient <= 0.0))
    free = (lower < upper) & ~is_held
    if not free.any():
        return 0.0
    gradient = point.gradient[free]
    normal = point.normal[np.ix_(free, free)]
    if not (np.isfinite(gradient).all() and np.isfinite(normal).all()):
        return float("inf")
    size, values, vectors, observable = scaled_eigen(normal)
    along = vectors[:, observable].T @ (gradient / size) / np.sqrt(values[observable])
    step = -(vectors[:, observable] @ (along / np.sqrt(values[observable]))) / size
    is_inside = (point.theta[free] + step >= lower[free]) & (point.theta[free] + step <= upper[free])
    if is_inside.all():
        return float(np.linalg.norm(along))
    from scipy.optimize import lsq_linear  # noqa: PLC0415 (loads for a fifth of a second)

    root = np.sqrt(values[observable])[:, None] * vectors[:, observable].T
    room = np.column_stack([lower, upper])[free] - point.theta[free, None]
    method = "bvls" if observable.all() else "trf"
    scaled_step = lsq_linear(root, -along, bounds=(room * size[:, None]).T, method=method).x
    predicted_reduction = -2.0 * float(gradient / size @ scaled_step) - float(np.sum((root @ scaled_step) ** 2))
    return float(np.sqrt(max(predicted_reduction, 0.0)))
