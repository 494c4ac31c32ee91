"""The recursion every Kalman filter here shares: over a record, forward and smoothed.

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

from hdt_core.estimation.conclude import conclude, settle
from hdt_core.estimation.estimate import Estimate, Status
from hdt_core.estimation.kalman_step import (
    Correction,
    Linearise,
    LostTrackError,
    corrected,
    innovate,
    is_moving,
    joint_belief,
    limits,
    outputs,
    predicted,
    projected,
    stepped,
    tangent,
)
from hdt_core.estimation.problem import Array, Belief, Problem

STILL_SD = 1e-4  # of its standard deviation: an estimate that another pass moves by less stands still


@dataclass(frozen=True, slots=True)
class FilterPass:
    """What one forward pass leaves: beliefs after each sample, (k, j) and (k, j, j), and what the smoother needs."""

    means: Array
    covs: Array
    slopes: list[Array]
    corrections: list[Correction]

    @property
    def log_likelihood(self) -> float:
        """Of the whole record."""
        return sum(c.log_likelihood for c in self.corrections)


def forward(
    problem: Problem, linearise: Linearise, about: list[Belief] | None = None, centre: Array | None = None
) -> FilterPass:
    """One pass over the record, linearised about the running belief, or about the k beliefs given; what nothing is
    known of starts at `centre` (n,)."""
    lower, upper = limits(problem)
    belief = joint_belief(problem, centre)
    k = len(problem.measured)
    means, covs = np.empty((k, belief.mean.size)), np.empty((k, belief.mean.size, belief.mean.size))
    slopes, corrections = [], []
    for i in range(k):
        point = belief if about is None else about[i]
        model = linearise(partial(outputs, problem, i), point, lower, upper)
        correction = innovate(belief, model, problem.measured[i], problem.sigma)
        belief = corrected(belief, correction)
        means[i], covs[i] = belief.mean, belief.cov
        corrections.append(correction)
        if i + 1 < k:
            step = stepped(problem, linearise, belief if about is None else about[i], i)
            belief = predicted(belief, step)
            slopes.append(step.slope)
    return FilterPass(means, covs, slopes, corrections)


def smoothed(filtered: FilterPass) -> list[Belief]:
    """Beliefs given the whole record, by Bryson and Frazier's adjoint: no covariance is ever inverted."""
    k, j = filtered.means.shape
    pull, weight = np.zeros(j), np.zeros((j, j))
    beliefs: list[Belief] = [Belief(filtered.means[-1], filtered.covs[-1])] * k
    for i in range(k - 1, -1, -1):
        mean, cov = filtered.means[i], filtered.covs[i]
        beliefs[i] = Belief(mean - cov @ pull, cov - cov @ weight @ cov)
        c = filtered.corrections[i]
        kept = np.eye(j) - c.gain @ c.slope
        pull = kept.T @ pull - c.slope.T @ c.precision @ c.innovation
        weight = kept.T @ weight @ kept + c.slope.T @ c.precision @ c.slope
        if i > 0:
            pull, weight = filtered.slopes[i - 1].T @ pull, filtered.slopes[i - 1].T @ weight @ filtered.slopes[i - 1]
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

    The path reported is that of the first pass: at every sample it knows only what came before.

    Parameters
    ----------
    passes : int
        At most, after the first.
    polish : bool
        Where nothing moves, finish with least squares: a regression's fixed point is near the optimum, not on it.
    """
    s = problem.start.mean.size
    try:
        with np.errstate(all="ignore"):  # what overflows ends as a lost track
            first = forward(problem, linearise, about)
            last, reached, more = _iterated(problem, linearise, first, passes)
    except (LostTrackError, np.linalg.LinAlgError):
        return lost(problem, n_evals + passes_cost(problem), method)
    path_sd = np.sqrt(np.maximum(np.diagonal(first.covs, axis1=1, axis2=2)[:, s:], 0.0))
    belief = Belief(last.means[-1, s:], last.covs[-1, s:, s:])
    n_evals += (1 + more) * passes_cost(problem)
    moved = standardised(problem, last.corrections) if is_moving(problem) else None
    told: dict[str, Any] = {"path": first.means[:, s:], "path_sd": path_sd, "method": method}
    return report(problem, belief, reached, n_evals, polish=polish, innovations=moved, **told)


def passes_cost(problem: Problem) -> int:
    """Evaluations of the model that a pass takes a sample."""
    return 2 * (problem.start.mean.size + problem.prior.mean.size) + 1


def _iterated(problem: Problem, linearise: Linearise, first: FilterPass, passes: int) -> tuple[FilterPass, Status, int]:
    """Filter again until the estimate stands still: the last pass, how it ended, passes made."""
    if is_moving(problem):
        return _iterated_moving(problem, linearise, first, passes)
    last, at = first, _point(problem, first)
    for made in range(1, passes + 1):
        about = smoothed(last) if linearise is not tangent else trajectory(problem, at)
        last = forward(problem, linearise, about, at)
        later = _paying(problem, at, _point(problem, last))
        still = _stands_still(later - at, last.covs[-1])
        at = later
        if still:
            return _moved_to(problem, last, at), "converged", made
    return _moved_to(problem, last, at), "approximate" if passes == 0 else "max_steps", passes


def _iterated_moving(
    problem: Problem, linearise: Linearise, first: FilterPass, passes: int
) -> tuple[FilterPass, Status, int]:
    """The same where states or parameters move: what is found is the most likely trajectory. Without any pass asked
    for, one is made to see whether it would change anything."""
    last = first
    for made in range(1, max(passes, 1) + 1):
        again = forward(problem, linearise, smoothed(last))
        still = _stands_still(again.means[-1] - last.means[-1], again.covs[-1])
        last = again if passes else last
        if still:
            return last, "converged", made
    return last, "max_steps" if passes else "approximate", max(passes, 1)


def _point(problem: Problem, filtered: FilterPass) -> Array:
    """Parameters (n,) after the last sample, inside the bounds."""
    s = problem.start.mean.size
    return projected(Belief(filtered.means[-1, s:], filtered.covs[-1, s:, s:]), *problem.bounds.T)


def _paying(problem: Problem, at: Array, later: Array) -> Array:
    """`later`, or as much of the way there as lowers the objective: the line search of Särkkä and Svensson (2020)."""
    shares = 0.5 ** np.arange(8)
    objectives = problem.objective(np.vstack([at, at + shares[:, None] * (later - at)]))
    if not np.isfinite(objectives[0]) or not (objectives[1:] < objectives[0]).any():
        return later
    return np.asarray(at + shares[int(np.argmax(objectives[1:] < objectives[0]))] * (later - at))


def _stands_still(move: Array, cov: Array) -> bool:
    sd = np.sqrt(np.maximum(cov.diagonal()[-move.size :], 0.0)) if move.size else np.zeros(0)
    return bool((np.abs(move) <= STILL_SD * sd + 1e-15).all())


def _moved_to(problem: Problem, filtered: FilterPass, theta: Array) -> FilterPass:
    """The pass with the parameters of its last belief at `theta`."""
    means = filtered.means.copy()
    means[-1, problem.start.mean.size :] = theta
    return replace(filtered, means=means)


def standardised(problem: Problem, corrections: list[Correction]) -> Array:
    """Innovations, each over its own standard deviation given those of its sample, (k, m); NaN where missing."""
    rows = np.full(problem.measured.shape, np.nan)
    for i, correction in enumerate(corrections):
        values, vectors = np.linalg.eigh(correction.precision)
        along = np.sqrt(np.maximum(values, 0.0)) * (vectors.T @ correction.innovation)
        rows[i, ~np.isnan(problem.measured[i])] = vectors @ along
    return rows


def compiled_estimate(
    problem: Problem, sigma_points: bool, smoother_passes: int, *, method: str, polish: bool = False
) -> Estimate | None:
    """The same by the problem's own kernel, which knows no noise but the sensor's; None where that does not serve."""
    if problem.kernels is None or problem.kernels.kalman is None or is_moving(problem):
        return None
    s = problem.start.mean.size
    prior = joint_belief(problem).cov[s:, s:]
    path, path_sd, mean, cov, made = problem.kernels.kalman(
        problem.origin,
        prior,
        np.isinf(problem.prior.sd),
        problem.bounds[:, 0],
        problem.bounds[:, 1],
        sigma_points,
        smoother_passes,
        STILL_SD,
    )
    passes = (1 + made) * (passes_cost(problem) if sigma_points else 2)
    told: dict[str, Any] = {"path": path, "path_sd": path_sd, "method": method}
    found = report(problem, Belief(mean, cov), "approximate", passes, polish=polish, **told)
    unsettled = smoother_passes > 0 and found.status in ("approximate", "diverged")
    return None if unsettled else found


def report(
    problem: Problem,
    belief: Belief,
    reached: Status,
    n_evals: int,
    *,
    path: Array,
    path_sd: Array,
    method: str,
    polish: bool = False,
    own_objective: bool = False,
    innovations: Array | None = None,
) -> Estimate:
    """Close a recursion: bounds on what is said, what the data can tell, and whether it ended on an optimum."""
    lower, upper = problem.bounds.T
    if not (np.isfinite(belief.mean).all() and np.isfinite(belief.cov).all()):
        return lost(problem, n_evals, method)
    path = np.minimum(np.maximum(path, lower), upper)
    told: dict[str, Any] = {"path": path, "path_sd": path_sd, "method": method, "innovations": innovations}
    said = projected(belief, lower, upper)
    if innovations is not None or own_objective:
        return conclude(problem, said, reached, n_evals, own_objective=True, cov=belief.cov, **told)
    if polish:
        return settle(problem, said, n_evals, cov=belief.cov, **told)
    return conclude(problem, said, reached, n_evals, cov=belief.cov, **told)


def lost(problem: Problem, n_evals: int, method: str) -> Estimate:
    """Close a recursion that met a sample the model has no answer for."""
    return conclude(problem, np.full(problem.prior.mean.size, np.nan), "diverged", n_evals, method=method)


def trajectory(problem: Problem, theta: Array) -> list[Belief]:
    """Beliefs about (states, parameters) without uncertainty to speak of, along the record."""
    x = problem.start.mean
    flat = np.zeros((x.size + theta.size,) * 2)
    beliefs = []
    for i in range(len(problem.measured)):
        beliefs.append(Belief(np.concatenate([x, theta]), flat))
        if problem.transition is not None:
            x = np.asarray(problem.transition(x, theta, i))
    return beliefs
