"""Recursion of fading-memory filters: gain from a faded covariance, stated covariance by Joseph's form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from hdt_core.estimation.estimate import Estimate, Status
from hdt_core.estimation.kalman import (
    STILL_SD,
    diverged_estimate,
    passes_cost,
    report,
    standardise_innovations,
    trajectory,
)
from hdt_core.estimation.kalman_step import (
    Correction,
    LostTrackError,
    innovate,
    is_moving,
    joint_belief,
    limits,
    linearise_step,
    outputs,
    predict_belief,
    project_on_bounds,
    tangent,
    update_belief,
)
from hdt_core.estimation.problem import Array, Belief, Problem

Factor = Callable[[Correction, Belief], float]
"""(what the sample would do without fading, predicted belief) -> factor on the predicted covariance, at least one."""


def fading_estimate(
    problem: Problem, factor: Callable[[], Factor], *, method: str, own_objective: bool, passes: int
) -> Estimate:
    """Run an extended Kalman filter with its predicted covariance inflated by a factor before each sample.

    Two covariances run along. The faded one sets the gain. It overstates the error, since what is forgotten was not
    wrong; so a second one follows the error that this gain really leaves, by Joseph's form, which holds for any
    gain. That one is stated.

    Where nothing is declared to move, further passes take their tangents about the trajectory of the last result,
    until it stands still. The path reported is that of the first pass.

    Parameters
    ----------
    factor : function () -> Factor
        Called once a pass.
    own_objective : bool
        The factor is the same for every record: what is minimised is a sum with weights that fade. Else it answers to
        the record: where it did so in a pass that should have been the plain filter, the first pass is the answer.
    passes : int
        At most, after the first.
    """
    cost = passes_cost(problem)
    n_passes = 1
    fields: dict[str, Any] = {"method": method}
    moving = is_moving(problem)
    try:
        with np.errstate(all="ignore"):  # what overflows ends as a lost track
            first = last = _pass(problem, factor(), None)
            reached: Status = "approximate"
            at = _inside(problem, first)
            while n_passes <= passes and not moving:
                last = _pass(problem, factor(), trajectory(problem, at), at)
                n_passes += 1
                later = _inside(problem, last)
                still = (np.abs(later - at) <= STILL_SD * last.belief.sd + 1e-15).all()
                at = later
                reached = "converged" if still else "max_steps"
                if still or (last.faded and not own_objective):
                    break
    except (LostTrackError, np.linalg.LinAlgError):
        return diverged_estimate(problem, cost * n_passes, method)
    if last.faded and not own_objective:
        last = first
        reached = "approximate"
        own_objective = True
    fields |= {"path": first.path, "path_sd": first.path_sd, "own_objective": own_objective}
    fields["innovations"] = last.innovations if moving else None
    return report(problem, last.belief, reached, cost * n_passes, **fields)


@dataclass(frozen=True, slots=True)
class _Pass:
    """Belief at the end, path and its sd (k, n), innovations over their sd (k, m), whether any gain was opened."""

    belief: Belief
    path: Array
    path_sd: Array
    innovations: Array
    faded: bool


def _inside(problem: Problem, result: _Pass) -> Array:
    return project_on_bounds(result.belief, *problem.bounds.T)


def _pass(problem: Problem, factor: Factor, about: list[Belief] | None, centre: Array | None = None) -> _Pass:
    belief = honest = joint_belief(problem, centre)
    bounds = limits(problem)
    ceiling = belief.cov.diagonal()[problem.start.mean.size :]
    s = problem.start.mean.size
    k = len(problem.measured)
    path = np.empty((k, belief.mean.size - s))
    path_sd = np.empty((k, belief.mean.size - s))
    corrections = []
    faded = False
    for i in range(k):
        point = belief if about is None else about[i]
        model = tangent(partial(outputs, problem, i), point, *bounds)
        plain = innovate(belief, model, problem.measured[i], problem.sigma)
        fade = factor(plain, belief) if plain.innovation.size else 1.0
        fade = max(min(fade, _headroom(belief, ceiling)), 1.0)
        wide = Belief(belief.mean, fade * belief.cov)
        correction = innovate(wide, model, problem.measured[i], problem.sigma)
        corrections.append(correction)
        faded |= fade > 1.0
        belief = update_belief(wide, correction)
        honest = Belief(belief.mean, update_belief(honest, correction).cov)
        path[i], path_sd[i] = belief.mean[s:], honest.sd[s:]
        if i + 1 < k:
            step = linearise_step(problem, tangent, belief if about is None else point, i)
            honest = predict_belief(honest, step)
            belief = predict_belief(belief, step)
    end = Belief(path[-1].copy(), honest.cov[s:, s:])
    return _Pass(end, path, path_sd, standardise_innovations(problem, corrections), faded)


def _headroom(belief: Belief, ceiling: Array) -> float:
    """Return the largest fading factor that keeps the covariance below the prior's."""
    variance = belief.cov.diagonal()[-ceiling.size :]
    free = variance > 0.0
    return float((ceiling[free] / variance[free]).min()) if free.any() else 1.0


def windowed_change(path: Array, sd: Array, window: int) -> tuple[Array, Array]:
    """Return mean and variance (k, n) of the last `window` rows of `path` (k, n) with sd (k, n)."""
    means = np.empty_like(path)
    variances = np.empty_like(path)
    for i in range(len(path)):
        recent = path[max(0, i + 1 - window) : i + 1]
        means[i], variances[i] = recent.mean(axis=0), recent.var(axis=0) + sd[i] ** 2
    return means, variances


@dataclass(frozen=True, slots=True)
class RecursiveLeastSquares:
    r"""Least squares over the record with weights that fade into the past by `forgetting` per sample.

    For a model linear in its parameters this is the textbook recursion,

    .. math:: P_i = \tfrac{1}{\lambda}(P_{i-1} - K_i h_i^T P_{i-1});

    elsewhere the model is replaced by its tangent about the running estimate. Forgetting buys the ability to follow
    a parameter that moves, at the price of an error that no longer shrinks: about 1 / (1 - forgetting) samples count.

    With forgetting it minimises this faded sum, not the problem's objective, and `converged` is said of the faded
    sum's optimum.

    Parameters
    ----------
    forgetting : float
        1, the default, forgets nothing: least squares, sample by sample.
    passes : int
        At most, after the first, about the trajectory of the pass before.

    References
    ----------
    .. [1] L. Ljung, System Identification: Theory for the User, 2nd ed., 1999, chapter 11.
    """

    name: str = "rls"
    forgetting: float = 1.0
    passes: int = 20

    def estimate(self, problem: Problem) -> Estimate:
        """Return the estimate after the last sample and the path of all."""

        def factor() -> Factor:
            return lambda _correction, _belief: 1.0 / self.forgetting

        return fading_estimate(
            problem, factor, method=self.name, own_objective=self.forgetting < 1.0, passes=self.passes
        )
