"""From the point where a method stopped to an estimate: covariance, status, and questions to the optimum."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hdt_core.estimation.damped import judged
from hdt_core.estimation.descent import Point, descend, distance_to_optimum, linearised
from hdt_core.estimation.doubts import Profile, better_optimum, is_bent, profiled
from hdt_core.estimation.estimate import Estimate, Status
from hdt_core.estimation.fit import noise_variance
from hdt_core.estimation.identifiability import SAFE, Identifiability, covariance_of_free
from hdt_core.estimation.problem import Array, Belief, Problem

CLOSE = 5e-4  # standard deviations to the optimum of the quadratic model: half of what `converged` promises
ROUNDING_DISTANCE = 1e-9  # declared standard deviations: what rounding leaves of the gradient of a noise-free record
APART = 0.5  # scaled determinant from which parameters are told apart well
MANY = 100  # values a parameter: with parameters well apart, the likelihood is a bell
WIDE = 6.0  # standard deviations: where the declared range holds fewer, the data have hardly narrowed it


def settle(
    problem: Problem, theta: Array, n_evals: int, *, polish: bool = True, cov: Array | None = None, **more: Any
) -> Estimate:
    """Close a method that does not end on the optimum by itself: least squares from `theta` (n,), where `polish`.

    The method's own covariance `cov` stands where the optimum lies within one of its standard deviations of `theta`.
    """
    if not np.isfinite(theta).all():
        return conclude(problem, theta, "diverged", n_evals, **more)
    if not polish:
        return conclude(problem, theta, "approximate", n_evals, cov=cov, **more)
    at = descend(problem, np.clip(theta, *problem.bounds.T), n_evals=n_evals)
    if cov is not None:
        moved, sd = np.abs(at.theta - theta), np.sqrt(np.maximum(np.diag(cov), 0.0))
        cov = cov if (moved <= sd).all() else None
    return conclude_at(problem, at, cov=cov, **more)


def conclude_at(problem: Problem, at: Point, **more: Any) -> Estimate:
    """Turn the end of a descent into an estimate."""
    if not at.objective < np.inf:
        return conclude(problem, at.theta * np.nan, "diverged", at.n_evals, **more)
    return conclude(problem, at.theta, "max_steps", at.n_evals, at=at, **more)


def conclude(
    problem: Problem,
    theta: Array,
    reached: Status,
    n_evals: int,
    *,
    at: Point | None = None,
    own_objective: bool = False,
    cov: Array | None = None,
    **more: Any,
) -> Estimate:
    """Turn a point into an estimate: covariance, what the data told, and the status that serves the reader best.

    A method that says `converged`, or `approximate`, is judged by the gradient at its point; then by whether a better
    optimum can be found where the misfit asks for a search, and by what the data tell of each parameter.

    Parameters
    ----------
    theta : array (n,)
        Where the method stopped.
    reached : Status
        How the method itself says it ended.
    at : Point, optional
        Gradient and curvature at `theta`; computed when not given.
    own_objective : bool
        The method minimises something else than the problem's objective, and has judged its gradient itself.
    cov : array (n, n), optional
        The method's own covariance; the inverse of data and prior information when not given. Where the residuals
        contradict the declared sigma, the data count by the variance that the residuals show.
    more
        Further fields of `Estimate`.
    """
    if at is None and not np.isfinite(theta).all():
        nothing = Identifiability(problem.names, np.zeros((theta.size, theta.size)))
        return Estimate(problem.prior, "diverged", n_evals, nothing, problem=problem, **more)
    at = linearised(problem, theta) if at is None else at
    prior = problem.prior.information
    seen = Identifiability(problem.names, at.normal - prior)
    own, determinant, distance, inside = judged(at.normal, at.gradient, theta, problem.bounds)
    inside, told, n_free = inside and determinant > SAFE, True, theta.size
    if not inside:
        own, told = covariance_of_free(problem.bounds, at.normal)
        distance = distance_to_optimum(at, problem.bounds)
        n_free = int(np.count_nonzero(problem.bounds[:, 0] < problem.bounds[:, 1]))
    variance = noise_variance(at.objective, problem.n_values, n_free)
    status: Status = reached
    if not own_objective and reached != "diverged":
        near = distance <= max(CLOSE * variance**0.5, ROUNDING_DISTANCE)
        status = "converged" if near else "max_steps" if reached == "converged" else reached
    if reached != "diverged" and not told:
        status = "not_identifiable"
    doubt = NO_DOUBT
    plain = variance == 1.0 and determinant > APART and problem.n_values > MANY * theta.size
    if status == "converged" and not own_objective:
        doubt = _narrowed(problem, own, variance) if plain else _questioned(problem, at, own, variance)
        status = doubt.status
    if status in ("converged", "approximate") and not inside:
        status = "at_bound" if _rests_on_bound(problem.bounds, theta, own) else status
    spread = own if cov is None else cov
    if variance > 1.0 and not own_objective and told:
        spread = spread + covariance_of_free(problem.bounds, seen.information / variance + prior)[0] - own
    return Estimate(
        Belief(theta, spread),
        status,
        n_evals,
        seen,
        n_checks=doubt.n_evals,
        distance=float("nan") if own_objective else distance,
        profile=doubt.profile,
        better=doubt.better,
        weak=doubt.weak,
        problem=problem,
        **more,
    )


@dataclass(frozen=True, slots=True)
class _Doubt:
    """What questions about an optimum led to, and the passes they took."""

    status: Status
    n_evals: int = 0
    profile: Profile | None = None
    better: Array | None = None
    weak: tuple[str, ...] = ()


NO_DOUBT = _Doubt("converged")


def _questioned(problem: Problem, at: Point, cov: Array, variance: float) -> _Doubt:
    """Ask of an optimum whether it is the best, where noise does not explain its misfit, and how far the data limit
    each parameter, where curvature may not tell."""
    spent = 0
    if variance > 1.0:
        better, spent = better_optimum(problem, at, variance)
        if better is not None:
            return _Doubt("local_optimum", spent, better=better.theta)
    spent += 2 * at.theta.size
    if not is_bent(problem, at, variance):
        return _narrowed(problem, cov, variance, spent)
    profile = profiled(problem, at, cov, variance)
    status: Status = "weakly_identifiable" if profile.unlimited else "converged"
    if profile.better is not None:
        status = "local_optimum"
    return _Doubt(status, spent + profile.n_evals, profile, profile.better, profile.unlimited)


def _narrowed(problem: Problem, cov: Array, variance: float, spent: int = 0) -> _Doubt:
    """Whether parameters without a prior keep most of their declared range.

    In plain floats: every fit is asked this, and NumPy on two numbers takes a tenth of the oscillator's time.
    """
    known, var = problem.prior.cov.diagonal().tolist(), cov.diagonal().tolist()
    weak = tuple(
        name
        for name, (low, high), told, v in zip(problem.names, problem.bounds.tolist(), known, var, strict=True)
        if told == float("inf") and low < high and WIDE**2 * v * variance > (high - low) ** 2
    )
    if weak:
        return _Doubt("weakly_identifiable", spent, weak=weak)
    return _Doubt("converged", spent) if spent else NO_DOUBT


def _rests_on_bound(bounds: Array, theta: Array, cov: Array) -> bool:
    """Whether a free parameter is within a thousandth of its standard deviation of a limit."""
    for (low, high), value, variance in zip(bounds.tolist(), theta.tolist(), cov.diagonal().tolist(), strict=True):
        margin = 1e-3 * min(variance, 1e300) ** 0.5
        if not low + margin < value < high - margin and low < high:
            return True
    return False
