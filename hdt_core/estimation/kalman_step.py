r"""Kalman filter step: update a belief by a sample and predict the next, with affine models.

The joint vector is z = (states, parameters). A method differs only in how it replaces the model by an affine one,

.. math:: z_{i+1} \approx A z_i + b + w, \quad y_i \approx H z_i + c + v,

by its tangent (extended) or by regression over sigma points (unscented). Bounds are kept where the model is evaluated
and where an estimate is reported but not in the belief, so the algebra of the smoother stays exact.

Prediction, gain and update take any leading axes, for many beliefs at once; each one's result is that of itself alone.

References
----------
.. [1] D. Simon, Optimal State Estimation, 2006, chapters 5 and 13.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hdt_core.estimation.problem import Array, Belief, Problem

if TYPE_CHECKING:
    from filterpy.kalman import MerweScaledSigmaPoints

HAIR = 1e-9  # of the mean: the least spread of sigma points
Function = Callable[[Array], Array]


class LostTrackError(ArithmeticError):
    """The model's output is not finite. Never leaves an estimator."""


@dataclass(frozen=True, slots=True)
class Affine:
    """y = slope z + offset + noise of covariance `spread`: (..., r, j), (..., r), (..., r, r)."""

    slope: Array
    offset: Array
    spread: Array


Linearise = Callable[[Function, Belief, Array, Array], Affine]
"""(function of the columns of z, belief about z, lower, upper) -> Affine; evaluated inside the bounds only."""


@dataclass(frozen=True, slots=True)
class Correction:
    """Update by one sample: slope H, gain K, inverse of S, innovation and noise of the recorded values."""

    slope: Array
    gain: Array
    precision: Array
    innovation: Array
    noise: Array


def is_moving(problem: Problem) -> bool:
    """Check whether states or parameters are random: process noise, drift, or an uncertain start."""
    noises = (problem.process_sd, problem.drift, problem.start.cov)
    return any(noise is not None and bool(np.any(noise > 0.0)) for noise in noises)


def joint_belief(problem: Problem, centre: Array | None = None) -> Belief:
    """Build the belief about (states, parameters) at sample 0.

    An infinite variance becomes that of the bounds' width, or of a thousand times the value where there are none. Such
    a parameter starts from `centre` (n,), where given: from its last estimate, so that passes end on the optimum of
    the data alone and not on one drawn towards the start.
    """
    s = problem.start.mean.size
    n = problem.prior.mean.size
    cov = np.zeros((s + n, s + n))
    cov[:s, :s] = problem.start.cov
    width = problem.bounds[:, 1] - problem.bounds[:, 0]
    wide = np.where(np.isfinite(width), width**2 / 12.0, 1e6 * np.maximum(np.abs(problem.prior.mean), 1.0) ** 2)
    is_known = np.isfinite(np.diag(problem.prior.cov))
    cov[s:, s:] = np.where(np.outer(is_known, is_known), problem.prior.cov, np.diag(wide))
    is_fixed = np.concatenate([np.zeros(s, bool), width == 0.0])
    cov[is_fixed] = 0.0
    cov[:, is_fixed] = 0.0
    origin = problem.origin if centre is None else np.where(is_known, problem.origin, centre)
    return Belief(np.concatenate([problem.start.mean, origin]), cov)


def innovate(belief: Belief, model: Affine, measured: Array, sigma: Array) -> Correction:
    """Compute gain and innovation of one sample, without missing values.

    Raises
    ------
    LostTrackError
        The model's output is not finite at this sample.
    """
    if not (np.isfinite(model.slope).all() and np.isfinite(model.offset).all()):
        raise LostTrackError
    slope = model.slope
    noise = model.spread + np.diag(sigma**2)
    error = measured - model.offset
    is_recorded = ~np.isnan(measured)
    if not is_recorded.all():
        slope = slope[is_recorded]
        noise = noise[np.ix_(is_recorded, is_recorded)]
        error = error[is_recorded]
    return compute_gain(belief, Affine(slope, np.zeros(len(error)), noise), error)


def compute_gain(belief: Belief, model: Affine, measured: Array) -> Correction:
    """Compute gain and innovation of complete samples, (..., r)."""
    across = belief.cov @ model.slope.mT
    precision = _inverse(model.slope @ across + model.spread)
    innovation = measured - model.offset - _product(model.slope, belief.mean)
    return Correction(model.slope, across @ precision, precision, innovation, model.spread)


def _product(matrix: Array, vector: Array) -> Array:
    return np.asarray((matrix @ vector[..., None])[..., 0])


def _inverse(cov: Array) -> Array:
    """Invert the innovations' covariance, by the pseudoinverse where rounding has made it singular."""
    if cov.shape[-1] == 1:
        return np.asarray(1.0 / cov)
    try:
        return np.asarray(np.linalg.inv(cov))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(cov, hermitian=True))


def update_belief(belief: Belief, correction: Correction) -> Belief:
    """Update a belief by a sample in Joseph's form: a covariance for any gain, and symmetric for every rounding."""
    gain = correction.gain
    complement = np.eye(belief.mean.shape[-1]) - gain @ correction.slope
    cov = complement @ belief.cov @ complement.mT + gain @ correction.noise @ gain.mT
    return Belief(belief.mean + _product(gain, correction.innovation), 0.5 * (cov + cov.mT))


def linearise_step(problem: Problem, linearise: Linearise, point: Belief, i: int) -> Affine:
    """Linearise the step from sample i to the next about `point`, (j, j), with process noise and drift."""
    s = problem.start.mean.size
    j = point.mean.size
    slope = np.eye(j)
    offset = np.zeros(j)
    noise = np.zeros((j, j))
    if problem.transition is not None:
        model = linearise(partial(_next_states, problem, i), point, *limits(problem))
        slope[:s], offset[:s], noise[:s, :s] = model.slope, model.offset, model.spread
    if problem.process_sd is not None:
        noise[:s, :s] += np.diag(problem.process_sd**2)
    if problem.drift is not None:
        noise[s:, s:] += np.diag(problem.drift**2)
    return Affine(slope, offset, noise)


def predict_belief(belief: Belief, model: Affine) -> Belief:
    """Predict a belief one step later, or a sample by the model of its outputs."""
    mean = _product(model.slope, belief.mean) + model.offset
    return Belief(mean, model.slope @ belief.cov @ model.slope.mT + model.spread)


def outputs(problem: Problem, i: int, z: Array) -> Array:
    """Compute outputs at sample i of the columns of z (j, p): (m, p)."""
    s = problem.start.mean.size
    return np.broadcast_to(np.asarray(problem.observe(z[:s], z[s:], i)), (problem.sigma.size, z.shape[1]))


def _next_states(problem: Problem, i: int, z: Array) -> Array:
    s = problem.start.mean.size
    assert problem.transition is not None
    return np.asarray(problem.transition(z[:s], z[s:], i))


def limits(problem: Problem) -> tuple[Array, Array]:
    """Return lower and upper limits of the joint vector: none on the states. (j,), (j,)"""
    free = np.full(problem.start.mean.size, np.inf)
    return np.concatenate([-free, problem.bounds[:, 0]]), np.concatenate([free, problem.bounds[:, 1]])


def project_on_bounds(belief: Belief, lower: Array, upper: Array) -> Array:
    """Find the most likely point with the violated bounds met exactly. (n,)"""
    mean = belief.mean
    if ((lower <= mean) & (mean <= upper)).all():
        return mean
    for _ in range(mean.size):
        violations = np.flatnonzero((mean < lower) | (mean > upper))
        if violations.size == 0:
            return mean
        limit = np.clip(mean, lower, upper)
        across = belief.cov[np.ix_(violations, violations)]
        mean = mean + belief.cov[:, violations] @ np.linalg.pinv(across, hermitian=True) @ (limit - mean)[violations]
        mean[violations] = limit[violations]
    return np.clip(mean, lower, upper)


def tangent(function: Function, belief: Belief, lower: Array, upper: Array) -> Affine:
    """Linearise at the mean moved inside the bounds, by central differences, one-sided on a bound."""
    point = np.clip(belief.mean, lower, upper)
    step = np.cbrt(np.finfo(float).eps) * np.maximum(np.abs(point), np.minimum(belief.sd, 1e3) + 1e-6)
    above = np.minimum(point + step, upper)
    below = np.maximum(point - step, lower)
    ends = np.column_stack([point[:, None] + np.diag(above - point), point[:, None] + np.diag(below - point), point])
    values = function(ends)
    j = point.size
    width = np.where(above > below, above - below, np.inf)
    slope = (values[:, :j] - values[:, j : 2 * j]) / width
    return Affine(slope, values[:, -1] - slope @ point, np.zeros((len(values), len(values))))


def regression(
    points: MerweScaledSigmaPoints, function: Function, belief: Belief, lower: Array, upper: Array
) -> Affine:
    """Fit an affine function with the mean, cross-covariance and covariance of `function` over sigma points.

    Raises
    ------
    LostTrackError
        The belief, or the model over it, is not finite.
    """
    if not (np.isfinite(belief.mean).all() and np.isfinite(belief.cov).all()):
        raise LostTrackError
    breadth = np.square(HAIR * belief.mean)  # sigma points must differ from the mean beyond rounding
    cloud = points.sigma_points(belief.mean, belief.cov + np.diag(breadth)).T
    values = function(np.clip(cloud, lower[:, None], upper[:, None]))
    if not np.isfinite(values).all():
        raise LostTrackError
    mean = values @ points.Wm
    deviation = cloud - belief.mean[:, None]
    response = values - mean[:, None]
    # pairs of opposite points: their difference over their distance is exact however flat the belief
    j = belief.mean.size
    half = 0.5 * (deviation[:, 1 : j + 1] - deviation[:, j + 1 :])
    slope = np.linalg.solve(half.T, 0.5 * (values[:, 1 : j + 1] - values[:, j + 1 :]).T).T
    residual = response - slope @ deviation
    return Affine(slope, mean - slope @ belief.mean, (residual * points.Wc) @ residual.T)


def upper_root(cov: Array) -> Array:
    """Compute an upper triangular root of a covariance that may be singular, by rounding or by design.

    A covariance without a Cholesky factor gets the least multiple of its own diagonal that gives it one. Directions
    without variance get a tiny one, enough to take a derivative along them.
    """
    size = np.sqrt(np.maximum(np.diag(cov), 0.0))
    size = np.where(size > 0.0, size, 1e-6 * max(float(size.max(initial=0.0)), 1e-6))
    scaled = cov / np.outer(size, size)
    np.fill_diagonal(scaled, 1.0)
    for lift in (0.0, 1e-14, 1e-12, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2):
        try:
            lower = np.linalg.cholesky(scaled + lift * np.eye(len(cov)))
        except np.linalg.LinAlgError:
            continue
        return np.asarray((lower * size[:, None]).T)
    return np.diag(size)
