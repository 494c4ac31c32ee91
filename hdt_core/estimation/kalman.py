"""Extended and unscented Kalman filter of states and parameters: over a record, forward and smoothed.

References
----------
.. [1] D. Simon, Optimal State Estimation, 2006, chapter 9.
.. [2] A. F. García-Fernández, L. Svensson and S. Särkkä, Iterated posterior linearization smoother, IEEE TAC 62(4),
   2017.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from hdt_core.estimation.conclude import compare_with_descent, conclude, settle
from hdt_core.estimation.estimate import Estimate, Status
from hdt_core.estimation.kalman_step import (
    Correction,
    Linearise,
    LostTrackError,
    innovate,
    is_moving,
    joint_belief,
    limits,
    linearise_step,
    outputs,
    predict_belief,
    project_on_bounds,
    regression,
    tangent,
    update_belief,
    upper_root,
)
from hdt_core.estimation.problem import Array, Belief, Problem

STILL_SD = 1e-4  # of its standard deviation: an estimate that another pass moves by less has settled
HARDLY_NARROWED = 0.5  # of the start's deviation: what a filter keeps that has learned nothing of a parameter


@dataclass(frozen=True, slots=True)
class FilterPass:
    """Result of a forward pass: beliefs after each sample, (k, j) and (k, j, j), and inputs of the smoother."""

    means: Array
    covs: Array
    slopes: list[Array]
    corrections: list[Correction]


def forward(
    problem: Problem, linearise: Linearise, about: list[Belief] | None = None, centre: Array | None = None
) -> FilterPass:
    """Filter the record once, linearised about the running belief, or about the k beliefs given; parameters without a
    prior start at `centre` (n,)."""
    lower, upper = limits(problem)
    belief = joint_belief(problem, centre)
    k = len(problem.measured)
    means = np.empty((k, belief.mean.size))
    covs = np.empty((k, belief.mean.size, belief.mean.size))
    slopes = []
    corrections = []
    for i in range(k):
        point = belief if about is None else about[i]
        model = linearise(partial(outputs, problem, i), point, lower, upper)
        correction = innovate(belief, model, problem.measured[i], problem.sigma)
        belief = update_belief(belief, correction)
        means[i], covs[i] = belief.mean, belief.cov
        corrections.append(correction)
        if i + 1 < k:
            step = linearise_step(problem, linearise, belief if about is None else about[i], i)
            belief = predict_belief(belief, step)
            slopes.append(step.slope)
    return FilterPass(means, covs, slopes, corrections)


def smooth(filtered: FilterPass) -> list[Belief]:
    """Compute beliefs given the whole record, by Bryson and Frazier's adjoint, which inverts no covariance."""
    k, j = filtered.means.shape
    pull = np.zeros(j)
    weight = np.zeros((j, j))
    beliefs: list[Belief] = [Belief(filtered.means[-1], filtered.covs[-1])] * k
    for i in range(k - 1, -1, -1):
        mean = filtered.means[i]
        cov = filtered.covs[i]
        beliefs[i] = Belief(mean - cov @ pull, cov - cov @ weight @ cov)
        c = filtered.corrections[i]
        complement = np.eye(j) - c.gain @ c.slope
        pull = complement.T @ pull - c.slope.T @ c.precision @ c.innovation
        weight = complement.T @ weight @ complement + c.slope.T @ c.precision @ c.slope
        if i > 0:
            pull = filtered.slopes[i - 1].T @ pull
            weight = filtered.slopes[i - 1].T @ weight @ filtered.slopes[i - 1]
    return beliefs


def recursive_estimate(
    problem: Problem,
    linearise: Linearise,
    passes: int,
    *,
    method: str,
    about: list[Belief] | None = None,
    n_evals: int = 0,
    polish: bool = False,
) -> Estimate:
    """Filter the record, then filter it again about the smoothed trajectory until the estimate settles.

    The path reported is that of the first pass, which is causal.

    Parameters
    ----------
    passes : int
        At most, after the first.
    polish : bool
        Where nothing moves, finish with least squares: a regression's fixed point is near the optimum, not on it.
    """
    s = problem.start.mean.size
    try:
        with np.errstate(all="ignore"):  # an overflow ends as a lost track
            first = forward(problem, linearise, about)
            last, status, n_passes = _iterate(problem, linearise, first, passes)
    except (LostTrackError, np.linalg.LinAlgError):
        return diverged_estimate(problem, n_evals + passes_cost(problem), method)
    path_sd = np.sqrt(np.maximum(np.diagonal(first.covs, axis1=1, axis2=2)[:, s:], 0.0))
    belief = Belief(last.means[-1, s:], last.covs[-1, s:, s:])
    n_evals += (1 + n_passes) * passes_cost(problem)
    innovations = standardise_innovations(problem, last.corrections) if is_moving(problem) else None
    fields: dict[str, Any] = {"path": first.means[:, s:], "path_sd": path_sd, "method": method}
    return report(problem, belief, status, n_evals, polish=polish, innovations=innovations, **fields)


def passes_cost(problem: Problem) -> int:
    """Count evaluations of the model in a pass, a sample."""
    return 2 * (problem.start.mean.size + problem.prior.mean.size) + 1


def _iterate(problem: Problem, linearise: Linearise, first: FilterPass, passes: int) -> tuple[FilterPass, Status, int]:
    """Filter again until the estimate settles; return the last pass, its status and the number of passes."""
    if is_moving(problem):
        return _iterate_moving(problem, linearise, first, passes)
    last = first
    at = _point(problem, first)
    for n_passes in range(1, passes + 1):
        about = smooth(last) if linearise is not tangent else trajectory(problem, at)
        last = forward(problem, linearise, about, at)
        new_theta = _line_search(problem, at, _point(problem, last))
        is_settled = _stands_still(new_theta - at, last.covs[-1])
        at = new_theta
        if is_settled:
            return _with_last_mean(problem, last, at), "converged", n_passes
    return _with_last_mean(problem, last, at), "approximate" if passes == 0 else "max_steps", passes


def _iterate_moving(
    problem: Problem, linearise: Linearise, first: FilterPass, passes: int
) -> tuple[FilterPass, Status, int]:
    """Iterate for moving states or parameters, to the most likely trajectory; at least once, to check for a change."""
    last = first
    for n_passes in range(1, max(passes, 1) + 1):
        next_pass = forward(problem, linearise, smooth(last))
        is_settled = _stands_still(next_pass.means[-1] - last.means[-1], next_pass.covs[-1])
        last = next_pass if passes else last
        if is_settled:
            return last, "converged", n_passes
    return last, "max_steps" if passes else "approximate", max(passes, 1)


def _point(problem: Problem, filtered: FilterPass) -> Array:
    """Return the parameters (n,) after the last sample, inside the bounds."""
    s = problem.start.mean.size
    return project_on_bounds(Belief(filtered.means[-1, s:], filtered.covs[-1, s:, s:]), *problem.bounds.T)


def _line_search(problem: Problem, at: Array, target: Array) -> Array:
    """Search the line to `target` for a lower objective, else return `target` (Särkkä and Svensson 2020)."""
    shares = 0.5 ** np.arange(8)
    objectives = problem.objective(np.vstack([at, at + shares[:, None] * (target - at)]))
    if not np.isfinite(objectives[0]) or not (objectives[1:] < objectives[0]).any():
        return target
    return np.asarray(at + shares[int(np.argmax(objectives[1:] < objectives[0]))] * (target - at))


def _stands_still(move: Array, cov: Array) -> bool:
    """Check whether an estimate moved by less than `STILL_SD` of its standard deviations."""
    sd = np.sqrt(np.maximum(cov.diagonal()[-move.size :], 0.0)) if move.size else np.zeros(0)
    return bool((np.abs(move) <= STILL_SD * sd + 1e-15).all())


def _with_last_mean(problem: Problem, filtered: FilterPass, theta: Array) -> FilterPass:
    """Replace the parameters of the pass's last belief by `theta`."""
    means = filtered.means.copy()
    means[-1, problem.start.mean.size :] = theta
    return replace(filtered, means=means)


def standardise_innovations(problem: Problem, corrections: list[Correction]) -> Array:
    """Whiten innovations over their standard deviations by sample, (k, m); NaN where missing."""
    rows = np.full(problem.measured.shape, np.nan)
    for i, correction in enumerate(corrections):
        values, vectors = np.linalg.eigh(correction.precision)
        along = np.sqrt(np.maximum(values, 0.0)) * (vectors.T @ correction.innovation)
        rows[i, ~np.isnan(problem.measured[i])] = vectors @ along
    return rows


def kernel_estimate(
    problem: Problem, sigma_points: bool, smoother_passes: int, *, method: str, polish: bool = False
) -> Estimate | None:
    """Estimate by the problem's own kernel, which has sensor noise only; None where that does not apply."""
    if problem.kernels is None or problem.kernels.kalman is None or is_moving(problem):
        return None
    s = problem.start.mean.size
    prior = joint_belief(problem).cov[s:, s:]
    start = (problem.origin, prior, np.isinf(problem.prior.sd), *problem.bounds.T)
    path, path_sd, mean, cov, n_passes = problem.kernels.kalman(*start, sigma_points, smoother_passes, STILL_SD)
    passes = (1 + n_passes) * (passes_cost(problem) if sigma_points else 2)
    fields: dict[str, Any] = {"path": path, "path_sd": path_sd, "method": method}
    estimate = report(problem, Belief(mean, cov), "approximate", passes, polish=polish, **fields)
    is_inconclusive = smoother_passes > 0 and estimate.status in ("approximate", "diverged")
    return None if is_inconclusive else estimate


def report(
    problem: Problem,
    belief: Belief,
    status: Status,
    n_evals: int,
    *,
    path: Array,
    polish: bool = False,
    own_objective: bool = False,
    innovations: Array | None = None,
    **fields: Any,
) -> Estimate:
    """Finish a recursion: project on the bounds, compute information and status."""
    if not (np.isfinite(belief.mean).all() and np.isfinite(belief.cov).all()):
        return diverged_estimate(problem, n_evals, fields["method"])
    theta = project_on_bounds(belief, *problem.bounds.T)
    own_objective = own_objective or innovations is not None
    cov = belief.cov if own_objective or has_learned(problem, belief) else None
    fields |= {"path": np.clip(path, *problem.bounds.T), "innovations": innovations, "cov": cov}
    if own_objective:
        return conclude(problem, theta, status, n_evals, own_objective=True, **fields)
    end = settle if polish else partial(conclude, outcome=status)
    return compare_with_descent(problem, end(problem, theta, n_evals=n_evals, **fields))


def has_learned(problem: Problem, belief: Belief) -> bool:
    """Check whether the filter narrowed every free parameter from what it began with.

    Sigma points spread over a wide start may lie where the model is flat: then the covariance stays the start's however
    much the record holds, and only the curvature at the optimum measures that.
    """
    n = problem.prior.mean.size
    start = joint_belief(problem).cov.diagonal()[-n:]
    return bool((belief.cov.diagonal() <= HARDLY_NARROWED**2 * start).all())


def diverged_estimate(problem: Problem, n_evals: int, method: str) -> Estimate:
    """Report a recursion that met a sample at which the model fails."""
    return conclude(problem, np.full(problem.prior.mean.size, np.nan), "diverged", n_evals, method=method)


def trajectory(problem: Problem, theta: Array) -> list[Belief]:
    """Simulate beliefs about (states, parameters) without uncertainty along the record."""
    x = problem.start.mean
    flat = np.zeros((x.size + theta.size,) * 2)
    beliefs = []
    for i in range(len(problem.measured)):
        beliefs.append(Belief(np.concatenate([x, theta]), flat))
        if problem.transition is not None:
            x = np.asarray(problem.transition(x, theta, i))
    return beliefs


@dataclass(frozen=True, slots=True)
class ExtendedKalman:
    """Filter, then filter again about the smoothed trajectory: the iterated extended Kalman smoother.

    Without a smoother pass the result keeps the errors of early tangents, taken where the guess was wrong.
    Where nothing drifts, one pass is one step of Gauss and Newton, shortened where it would raise the objective.

    Parameters
    ----------
    smoother_passes : int
        At most: they end when the estimate settles. With none the causal filter's own answer is reported.

    References
    ----------
    .. [1] S. Särkkä and L. Svensson, Levenberg-Marquardt and line-search extended Kalman smoothers, ICASSP 2020.
    """

    name: str = "ekf"
    smoother_passes: int = 20

    def estimate(self, problem: Problem) -> Estimate:
        """Estimate the parameters after the last sample; path of the first, causal pass."""
        quick = kernel_estimate(problem, False, self.smoother_passes, method=self.name)
        if quick is not None:
            return quick
        return recursive_estimate(problem, tangent, self.smoother_passes, method=self.name)


@dataclass(frozen=True, slots=True)
class UnscentedKalman:
    """Filter, then filter again with regressions over the smoothed beliefs: iterated posterior linearisation.

    Parameters
    ----------
    alpha, beta, kappa : float
        Spread of Merwe's scaled points. The defaults give equal weights, none negative, so that the residual
        covariance stays positive.
    smoother_passes : int
        At most: they end when the estimate settles.
    polish : bool
        Where nothing moves, finish with least squares: the fixed point of a regression is near the optimum, not on it.
    """

    name: str = "ukf"
    alpha: float = 1.0
    beta: float = 0.0
    kappa: float = 0.0
    smoother_passes: int = 5
    polish: bool = True

    def estimate(self, problem: Problem) -> Estimate:
        """Estimate the parameters after the last sample; path of the first, causal pass."""
        if (self.alpha, self.beta, self.kappa) == (1.0, 0.0, 0.0):
            quick = kernel_estimate(problem, True, self.smoother_passes, method=self.name, polish=self.polish)
            if quick is not None:
                return quick
        from filterpy.kalman import MerweScaledSigmaPoints  # noqa: PLC0415 (a second of imports that only this needs)

        j = problem.start.mean.size + problem.prior.mean.size
        points = MerweScaledSigmaPoints(j, self.alpha, self.beta, self.kappa, sqrt_method=upper_root)
        return recursive_estimate(
            problem, partial(regression, points), self.smoother_passes, method=self.name, polish=self.polish
        )
