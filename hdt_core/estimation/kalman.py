"""The recursion every Kalman filter here shares: over a record, forward and smoothed.

References
----------
.. [1] D. Simon, Optimal State Estimation, 2006, chapter 9.
.. [2] A. F. García-Fernández, L. Svensson and S. Särkkä, Iterated posterior linearization smoother, IEEE TAC 62(4),
   2017.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from hdt_core.estimation.estimate import Estimate, Status, conclude
from hdt_core.estimation.kalman_step import (
    Correction,
    Linearise,
    LostTrackError,
    corrected,
    innovate,
    joint_belief,
    limits,
    outputs,
    predicted,
    projected,
    stepped,
)
from hdt_core.estimation.problem import Array, Belief, Problem

WORST_NIS = 25.0  # innovations five times their size on average: the filter has lost the record


@dataclass(frozen=True, slots=True)
class Filtered:
    """What one forward pass leaves: beliefs after each sample, (k, j) and (k, j, j), and what the smoother needs."""

    means: Array
    covs: Array
    slopes: list[Array]
    corrections: list[Correction]

    @property
    def log_likelihood(self) -> float:
        """Of the whole record."""
        return sum(c.log_likelihood for c in self.corrections)

    @property
    def mean_nis(self) -> float:
        """Mean normalised innovation squared per value: one where model and noise are as declared."""
        return sum(c.nis for c in self.corrections) / max(sum(c.innovation.size for c in self.corrections), 1)


def forward(problem: Problem, linearise: Linearise, about: list[Belief] | None = None) -> Filtered:
    """One pass over the record, linearised about the running belief, or about the k beliefs given."""
    lower, upper = limits(problem)
    belief = joint_belief(problem)
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
    return Filtered(means, covs, slopes, corrections)


def smoothed(filtered: Filtered) -> list[Belief]:
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
    problem: Problem, linearise: Linearise, smoother_passes: int, about: list[Belief] | None = None, n_evals: int = 0
) -> Estimate:
    """Filter the record, then filter it again about the smoothed trajectory, `smoother_passes` times.

    The path reported is that of the first pass: at every sample it knows only what came before.
    """
    s, j = problem.start.mean.size, problem.start.mean.size + problem.prior.mean.size
    try:
        first = final = forward(problem, linearise, about)
        for _ in range(smoother_passes):
            final = forward(problem, linearise, smoothed(final))
    except LostTrackError:
        return lost(problem, n_evals + 2 * j + 1)
    path_sd = np.sqrt(np.maximum(np.diagonal(first.covs, axis1=1, axis2=2)[:, s:], 0.0))
    belief = Belief(final.means[-1, s:], final.covs[-1, s:, s:])
    n_evals += (1 + smoother_passes) * (2 * j + 1)
    return report(problem, belief, first.means[:, s:], path_sd, n_evals=n_evals, mean_nis=final.mean_nis)


def compiled_estimate(problem: Problem, sigma_points: bool, smoother_passes: int) -> Estimate | None:
    """The same by the problem's own kernel, which knows no noise but the sensor's; None where that does not serve."""
    moving = any(sd is not None and np.any(sd > 0.0) for sd in (problem.process_sd, problem.drift))
    if problem.kernels is None or problem.kernels.kalman is None or moving or np.any(problem.start.cov > 0.0):
        return None
    prior = joint_belief(problem).cov[problem.start.mean.size :, problem.start.mean.size :]
    path, path_sd, mean, cov, nis = problem.kernels.kalman(
        problem.origin, prior, problem.bounds[:, 0], problem.bounds[:, 1], sigma_points, smoother_passes
    )
    passes = (1 + smoother_passes) * (2 * (problem.start.mean.size + mean.size) + 1 if sigma_points else 2)
    return report(problem, Belief(mean, cov), path, path_sd, n_evals=passes, mean_nis=nis)


def report(problem: Problem, belief: Belief, path: Array, path_sd: Array, *, n_evals: int, mean_nis: float) -> Estimate:
    """Close a recursion: bounds on what is said, what the data can tell, and whether it kept track."""
    lower, upper = problem.bounds.T
    if not (np.isfinite(belief.mean).all() and np.isfinite(belief.cov).all()):
        return lost(problem, n_evals)
    reached: Status = "converged" if mean_nis < WORST_NIS else "diverged"
    path = np.minimum(np.maximum(path, lower), upper)
    said = projected(belief, lower, upper)
    return conclude(problem, said, reached, n_evals, cov=belief.cov, path=path, path_sd=path_sd)


def lost(problem: Problem, n_evals: int) -> Estimate:
    """Close a recursion that met a sample the model has no answer for."""
    return conclude(problem, np.full(problem.prior.mean.size, np.nan), "diverged", n_evals)


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
