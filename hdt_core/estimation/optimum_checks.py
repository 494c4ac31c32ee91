"""Checks of an optimum: search for a better one, and profile of a likelihood that is not Gaussian about it.

Both cost evaluations, so each runs only after a cheap test: a misfit that noise does not explain, a rise along the
principal axes that the quadratic model does not predict.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from hdt_core.estimation.descent import Point, descend, descend_each
from hdt_core.estimation.problem import Array, Problem

LEADERS, MORE_STEPS = 4, 60  # of the search: descents, and steps of each
BETTER = 1e-4  # of the noise's variance: an objective lower by less is the same optimum
REACH = 2.0  # standard deviations at which the quadratic model is tested
RATIO = 2.0  # of the rise to the predicted one, or its inverse, from which the model fails the test
RISE = 3.841459  # of the objective at the ends of a 95 % interval of one parameter
AT_ONCE = 64  # problems of a batch that are searched together
MODEL = ("theta", "gradient", "normal")
STRETCHES = 12  # at most, to the end of an interval


@dataclass(frozen=True, slots=True)
class Profile:
    """Intervals by profile likelihood: the objective with one parameter fixed and all others refitted.

    Parameters
    ----------
    names : tuple of str
    interval : array (n, 2)
        Ends of the 95 % interval; infinite where the objective never rises enough, the bound where it cuts it short.
    open : array (n, 2) of bool
        Ends where the data set no limit.
    n_evals : int
    better : array (n,) or None
        A point of a lower objective, where there is one.

    References
    ----------
    .. [1] A. Raue et al., Structural and practical identifiability analysis of partially observed dynamical models by
       exploiting the profile likelihood, Bioinformatics 25(15), 2009.
    """

    names: tuple[str, ...]
    interval: Array
    open: Array
    n_evals: int
    better: Array | None = None

    @property
    def without_limit(self) -> tuple[str, ...]:
        """Parameters without a limit on one side or both."""
        return tuple(name for name, ends in zip(self.names, self.open, strict=True) if ends.any())


@dataclass(frozen=True, slots=True)
class OptimumTest:
    """Whether the likelihood departs from its curvature about an optimum, a better one, and the passes they took."""

    is_bent: bool
    better: Point | None = None
    n_evals: int = 0


def check_optima(problem: Problem, optima: Sequence[Point], variances: Array) -> list[OptimumTest]:
    """Test the optimum of each problem of a batch: its curvature; where noise does not explain the misfit, the box.

    Parameters
    ----------
    variances : array (b,)
        Of the noise over the declared one.
    """
    passes = 2 * int(np.count_nonzero(problem.bounds[:, 0] < problem.bounds[:, 1]))
    tests = [OptimumTest(bool(bent), n_evals=passes) for bent in is_nonquadratic(problem, optima, variances)]
    misfits = np.flatnonzero(variances > 1.0)
    for numbers in np.split(misfits, range(AT_ONCE, len(misfits), AT_ONCE)):
        ends = better_optima(problem.select(numbers), [optima[b] for b in numbers]) if len(numbers) else []
        for b, (end, n_evals) in zip(numbers, ends, strict=True):
            is_better = optima[b].objective - end.objective > least_improvement(float(variances[b]))
            tests[b] = replace(tests[b], better=end if is_better else None, n_evals=passes + n_evals)
    return tests


def better_optima(problem: Problem, optima: Sequence[Point]) -> list[tuple[Point, int]]:
    """Search the box of each problem of a batch for an optimum below its own; return the lowest point, and the passes.

    Half the points fill the box evenly, half lie about the optimum at other orders of magnitude; the best few descend.
    """
    from scipy.stats import qmc  # noqa: PLC0415 (loads for half a second)

    free = problem.bounds[:, 0] < problem.bounds[:, 1]
    lower, upper = problem.search_box
    power = 6 + min(int(free.sum()).bit_length() - 1, 3)
    unit = qmc.Sobol(free.size, rng=np.random.default_rng(0)).random_base2(power)[:, None]
    theta = np.array([at.theta for at in optima])
    cloud = np.repeat(lower + (upper - lower) * unit, len(optima), axis=1)
    cloud[::2] = np.clip(theta * 10.0 ** (2.0 * unit[::2] - 1.0), *problem.bounds.T)
    cloud[:, :, ~free] = problem.origin[~free]
    objectives = problem.objective_each(cloud)
    starts = [_distinct_points(cloud[:, b], objectives[:, b], upper - lower) for b in range(len(optima))]
    ends = [(at, len(cloud)) for at in optima]
    for rank in range(LEADERS):
        numbers = np.array([b for b, points in enumerate(starts) if len(points) > rank], int)
        origin = np.array([starts[b][rank] for b in numbers])
        points = descend_each(problem.select(numbers), origin, MORE_STEPS) if len(numbers) else []
        for b, end in zip(numbers, points, strict=True):
            best, n_evals = ends[b]
            ends[b] = (end if end.objective < best.objective else best, n_evals + end.n_evals)
    return ends


def least_improvement(variance: float) -> float:
    """Return the least reduction of the objective that counts as another optimum: at least (sigma / 1000) squared."""
    return max(BETTER * variance, 1e-6)


def _distinct_points(cloud: Array, objectives: Array, width: Array) -> Array:
    """Select the best few points that are not neighbours of each other."""
    rows: list[int] = []
    scale = np.where(width > 0.0, width, 1.0)
    for row in np.argsort(objectives, kind="stable"):
        if len(rows) == LEADERS or not np.isfinite(objectives[row]):
            break
        if all(np.abs((cloud[row] - cloud[previous]) / scale).max() > 0.05 for previous in rows):
            rows.append(int(row))
    return cloud[rows]


def is_nonquadratic(problem: Problem, optima: Sequence[Point], variances: Array) -> npt.NDArray[np.bool_]:
    """Check whether the objective of each problem of a batch, at two standard deviations along the principal axes,
    departs from its curvature's prediction, or a parameter without a prior may lie beyond its bound. (b,)"""
    free = np.flatnonzero(problem.bounds[:, 0] < problem.bounds[:, 1])
    theta, gradient, full_normal = (np.array([getattr(at, name) for at in optima]) for name in MODEL)
    normal = full_normal[:, free[:, None], free]
    size = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(normal / (size[:, :, None] * size[:, None, :]))
    is_singular = ~(values[:, 0] > 0.0)
    values = np.where(is_singular[:, None], 1.0, values)
    deviation = np.sqrt(variances)[:, None, None] * (vectors / np.sqrt(values)[:, None, :]) / size[:, :, None]
    reach = REACH * np.sqrt((deviation**2).sum(axis=2))
    lower, upper = problem.bounds[free].T
    is_beyond = (theta[:, free] - reach < lower) | (theta[:, free] + reach > upper)
    change = np.zeros((2 * free.size, *theta.shape))
    change[:, :, free] = REACH * np.concatenate([np.moveaxis(deviation, 2, 0), -np.moveaxis(deviation, 2, 0)])
    change = np.clip(theta + change, *problem.bounds.T) - theta
    predicted_rise = 2.0 * np.einsum("pbi,bi->pb", change, gradient)
    predicted_rise += np.einsum("pbi,bij,pbj->pb", change, full_normal, change)
    rise = problem.objective_each(theta + change) - np.array([at.objective for at in optima])
    is_testable = predicted_rise > 0.1 * REACH**2 * variances  # an end cut short by a bound is no test
    ratio = rise / np.where(is_testable, predicted_rise, 1.0)
    is_off = is_testable & ((ratio < 1.0 / RATIO) | (ratio > RATIO))
    return np.asarray(is_singular | (is_beyond & np.isinf(problem.prior.sd[free])).any(axis=1) | is_off.any(axis=0))


def profile_intervals(problem: Problem, optimum: Point, cov: Array, variance: float = 1.0) -> Profile:
    """Compute profile intervals of every free parameter from the optimum `at` with covariance `cov` (n, n).

    Parameters
    ----------
    variance : float
        Of the noise over the declared one: the target rise is 3.84 times this.
    """
    n = optimum.theta.size
    ends = np.tile(optimum.theta[:, None], (1, 2))
    without_limit = np.zeros((n, 2), bool)
    n_evals = 0
    lowest = optimum
    for i in np.flatnonzero(problem.bounds[:, 0] < problem.bounds[:, 1]):
        for side, sign in enumerate((-1.0, 1.0)):
            ends[i, side], without_limit[i, side], passes, low = _end(problem, optimum, cov, int(i), sign, variance)
            n_evals += passes
            lowest = low if low.objective < lowest.objective else lowest
    better = lowest.theta if lowest.objective < optimum.objective - least_improvement(variance) else None
    return Profile(problem.names, ends, without_limit, n_evals, better)


def _end(
    problem: Problem, optimum: Point, cov: Array, i: int, sign: float, variance: float
) -> tuple[float, bool, int, Point]:
    """Find the end of parameter i's interval on one side, whether it is open, passes, and the lowest point found."""
    wall = problem.bounds[i, int(sign > 0.0)]
    target_rise = RISE * variance
    sd = float(np.sqrt(cov[i, i] * variance))
    step = 1.96 * sd if np.isfinite(sd) and sd > 0.0 else max(abs(float(optimum.theta[i])), 1.0)
    inner = (0.0, 0.0)
    low = optimum
    passes = 0
    point = optimum
    for _ in range(STRETCHES):
        is_beyond = (optimum.theta[i] + sign * step - wall) * sign >= 0.0
        step = float(abs(wall - optimum.theta[i])) if is_beyond else step
        point = _refit_fixed(problem, point, i, wall if is_beyond else optimum.theta[i] + sign * step)
        passes = passes + point.n_evals
        low = point if point.objective < low.objective else low
        rise = point.objective - optimum.objective
        if rise >= target_rise:
            length, extra = _crossing(problem, optimum, point, (i, sign), (inner, (step, rise)), target_rise)
            return float(optimum.theta[i] + sign * length), False, passes + extra, low
        if is_beyond:
            return float(wall), True, passes, low
        inner = (step, max(rise, 0.0))
        step = 2.0 * step
    return sign * np.inf, True, passes, low


def _crossing(
    problem: Problem,
    optimum: Point,
    near: Point,
    way: tuple[int, float],
    bracket: tuple[tuple[float, float], tuple[float, float]],
    target_rise: float,
) -> tuple[float, int]:
    """Find the distance at which the profile has risen by `target_rise`, to 2 %, and the passes: false position on the
    root of the rise, which is linear for a parabola."""
    (inner, low), (outer, high) = bracket
    i, sign = way
    passes = 0
    for _ in range(6):
        share = (np.sqrt(target_rise) - np.sqrt(low)) / (np.sqrt(high) - np.sqrt(low)) if np.isfinite(high) else 0.5
        middle = inner + (outer - inner) * float(np.clip(share, 0.05, 0.95))
        start = near if np.isfinite(near.objective) else optimum
        near = _refit_fixed(problem, start, i, float(optimum.theta[i] + sign * middle))
        passes = passes + near.n_evals
        rise = max(near.objective - optimum.objective, 0.0)
        if abs(np.sqrt(rise / target_rise) - 1.0) < 0.02:
            return middle, passes
        inner, low, outer, high = (middle, rise, outer, high) if rise < target_rise else (inner, low, middle, rise)
    return outer, passes


def _refit_fixed(problem: Problem, near: Point, i: int, value: float) -> Point:
    """Refit all parameters but i, fixed at `value`, from the linear guess about the point `near`."""
    bounds = problem.bounds.copy()
    is_free = np.arange(near.theta.size) != i
    bounds[i] = value
    plain = np.where(is_free, near.theta, value)
    guess = plain.copy()
    if np.isfinite(near.normal).all():
        size = np.sqrt(np.maximum(near.normal.diagonal(), np.finfo(float).tiny))
        scaled_normal = near.normal / np.outer(size, size)
        pull = np.linalg.lstsq(scaled_normal[np.ix_(is_free, is_free)], scaled_normal[is_free, i], rcond=1e-9)[0]
        guess[is_free] -= pull * size[i] / size[is_free] * (value - near.theta[i])
    fixed_problem = replace(problem, bounds=bounds)
    starts = [np.clip(start, *bounds.T) for start in (guess, plain)]
    start = starts[int(np.argmin(fixed_problem.objective(np.array(starts))))]
    return descend(fixed_problem, start, 25, 2)
