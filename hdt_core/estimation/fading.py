"""The recursion of filters that forget: a gain from a faded covariance, a statement from an honest one."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from hdt_core.estimation.ekf import tangent
from hdt_core.estimation.estimate import Estimate
from hdt_core.estimation.kalman import lost, report, trajectory
from hdt_core.estimation.kalman_step import (
    Correction,
    LostTrackError,
    corrected,
    innovate,
    joint_belief,
    limits,
    outputs,
    predicted,
    stepped,
)
from hdt_core.estimation.problem import Array, Belief, Problem

Factor = Callable[[Correction, Belief], float]
"""(what the sample would do without fading, predicted belief) -> factor on the predicted covariance, at least one."""


def fading_estimate(
    problem: Problem, factor: Callable[[], Factor], may_relinearise: Callable[[Array], bool]
) -> Estimate:
    """Extended Kalman filter whose predicted covariance is multiplied by a factor before each sample.

    Two covariances run along. The faded one sets the gain. It overstates the error, since what is forgotten was not
    wrong; so a second one follows the error that this gain really leaves, by Joseph's form, which holds for any
    gain. That one is stated.

    Parameters
    ----------
    factor : function () -> Factor
        Called once a pass.
    may_relinearise : function (path (k, n)) -> bool
        Whether the parameters stood still, so that a second pass may take its tangents about the trajectory of the
        first one's result, without the errors of tangents taken where the guess was wrong. The path reported is that
        of the first pass.
    """
    passes = per_pass = 2 * (problem.start.mean.size + problem.prior.mean.size) + 1
    try:
        belief, path, path_sd, nis = _pass(problem, factor(), None)
        if may_relinearise(path):
            about = trajectory(problem, np.clip(belief.mean, *problem.bounds.T))
            belief, _, _, nis = _pass(problem, factor(), about)
            passes += per_pass
    except LostTrackError:
        return lost(problem, passes)
    return report(problem, belief, path, path_sd, n_evals=passes, mean_nis=nis)


def _pass(problem: Problem, factor: Factor, about: list[Belief] | None) -> tuple[Belief, Array, Array, float]:
    """Belief at the end, path and its sd (k, n), mean normalised innovation squared."""
    belief = honest = joint_belief(problem)
    bounds, ceiling = limits(problem), belief.cov.diagonal()[problem.start.mean.size :]
    s, k = problem.start.mean.size, len(problem.measured)
    path, path_sd = np.empty((k, belief.mean.size - s)), np.empty((k, belief.mean.size - s))
    nis, n_seen = 0.0, 0
    for i in range(k):
        point = belief if about is None else about[i]
        model = tangent(partial(outputs, problem, i), point, *bounds)
        plain = innovate(belief, model, problem.measured[i], problem.sigma)
        fade = factor(plain, belief) if plain.innovation.size else 1.0
        faded = Belief(belief.mean, max(min(fade, _headroom(belief, ceiling)), 1.0) * belief.cov)
        correction = innovate(faded, model, problem.measured[i], problem.sigma)
        nis, n_seen = nis + correction.nis, n_seen + correction.innovation.size
        belief = corrected(faded, correction)
        honest = Belief(belief.mean, corrected(honest, correction).cov)
        path[i], path_sd[i] = belief.mean[s:], honest.sd[s:]
        if i + 1 < k:
            step = stepped(problem, tangent, belief if about is None else point, i)
            honest, belief = predicted(honest, step), predicted(belief, step)
    return Belief(path[-1], honest.cov[s:, s:]), path, path_sd, nis / max(n_seen, 1)


def _headroom(belief: Belief, ceiling: Array) -> float:
    """How far a covariance may be faded before it winds up: to forget everything is to believe the prior, no less."""
    variance = belief.cov.diagonal()[-ceiling.size :]
    free = variance > 0.0
    return float((ceiling[free] / variance[free]).min()) if free.any() else 1.0


def windowed_change(path: Array, sd: Array, window: int) -> tuple[Array, Array]:
    """Mean and variance of the last `window` rows of `path` (k, n), each known to sd (k, n): (k, n) each."""
    means, variances = np.empty_like(path), np.empty_like(path)
    for i in range(len(path)):
        recent = path[max(0, i + 1 - window) : i + 1]
        means[i], variances[i] = recent.mean(axis=0), recent.var(axis=0) + sd[i] ** 2
    return means, variances
