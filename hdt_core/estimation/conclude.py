"""Turn the point where a method stopped into an estimate: covariance, status, and checks of the optimum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from hdt_core.estimation.compiled import AT_BOUND_SD, assess_optimum
from hdt_core.estimation.descent import (
    Point,
    descend,
    descend_from_start,
    distance_to_optimum,
    quadratic_model,
)
from hdt_core.estimation.estimate import Estimate, Status
from hdt_core.estimation.fit import Identifiability, covariance_of_free, noise_variance
from hdt_core.estimation.optimum_checks import (
    OptimumTest,
    Profile,
    check_optima,
    least_improvement,
    profile_intervals,
)
from hdt_core.estimation.problem import Array, Belief, Problem

CLOSE = 5e-4  # standard deviations to the optimum of the quadratic model: half of what `converged` promises
ROUNDING_DISTANCE = 1e-9  # declared standard deviations: what rounding leaves of the gradient of a noise-free record
SAFE = 1e-10  # a scaled determinant from which a Cholesky factor is as good as an eigenvalue decomposition
SEPARATE = 0.5  # scaled determinant from which parameters are well separated
VALUES_A_PARAMETER = 100  # values a parameter: with parameters well separated, the likelihood is Gaussian
WIDE = 6.0  # standard deviations: a declared range with fewer is hardly narrowed by the data


def settle(
    problem: Problem, theta: Array, n_evals: int, *, polish: bool = True, cov: Array | None = None, **fields: Any
) -> Estimate:
    """Finish a method that does not end on the optimum by itself: least squares from `theta` (n,), where `polish`;
    `Estimate.method` then names them.

    The method's own covariance `cov` is kept where the optimum lies within one of its standard deviations of `theta`.
    """
    if not np.isfinite(theta).all():
        return conclude(problem, theta, "diverged", n_evals, **fields)
    if not polish:
        return conclude(problem, theta, "approximate", n_evals, cov=cov, **fields)
    point = descend(problem, np.clip(theta, *problem.bounds.T), n_evals=n_evals)
    fields["method"] = f"{fields.get('method', '')}, finished by least squares"
    if cov is not None:
        change = np.abs(point.theta - theta)
        sd = np.sqrt(np.maximum(np.diag(cov), 0.0))
        cov = cov if (change <= sd).all() else None
    return conclude_at(problem, point, cov=cov, **fields)


def conclude_at(problem: Problem, point: Point, **fields: Any) -> Estimate:
    """Turn the end of a descent into an estimate."""
    if not point.objective < np.inf:
        return conclude(problem, point.theta * np.nan, "diverged", point.n_evals, **fields)
    return conclude(problem, point.theta, "max_steps", point.n_evals, point=point, **fields)


def conclude_each(problem: Problem, points: Sequence[Point], **fields: Any) -> list[Estimate]:
    """Turn the ends of a batch's descents into estimates."""
    singles = [problem.single(b) for b in range(len(points))]
    tests = dict[int, OptimumTest]()
    finite = [b for b, point in enumerate(points) if point.objective < np.inf]
    if finite:
        ends = [points[b] for b in finite]
        variances = np.array([noise_of(singles[b], points[b]) for b in finite])
        tests = dict(zip(finite, check_optima(problem.select(np.array(finite)), ends, variances), strict=True))
    return [conclude_at(single, points[b], test=tests.get(b), **fields) for b, single in enumerate(singles)]


def noise_of(problem: Problem, point: Point) -> float:
    """Compute the variance of the noise over the declared one: see `noise_variance`."""
    n_free = int(np.count_nonzero(problem.bounds[:, 0] < problem.bounds[:, 1]))
    return noise_variance(point.objective, problem.n_values, n_free)


def conclude(
    problem: Problem,
    theta: Array,
    outcome: Status,
    n_evals: int,
    *,
    point: Point | None = None,
    own_objective: bool = False,
    cov: Array | None = None,
    test: OptimumTest | None = None,
    **fields: Any,
) -> Estimate:
    """Turn a point into an estimate: covariance, information of the data, and status.

    A method that reports `converged`, or `approximate`, is checked by the gradient at its point; then by a search for a
    better optimum where the misfit is large, and by the data's information on each parameter.

    Parameters
    ----------
    theta : array (n,)
        Where the method stopped.
    outcome : Status
        Status that the method itself reports.
    point : Point, optional
        Gradient and curvature at `theta`; computed when not given.
    own_objective : bool
        The method minimises another objective than the problem's, and has checked its gradient itself.
    cov : array (n, n), optional
        The method's own covariance; the inverse of data and prior information when not given. Where the residuals
        contradict the declared sigma, the data count by the variance that the residuals have.
    test : OptimumTest, optional
        Of the optimum; done when not given.
    fields
        Further fields of `Estimate`.
    """
    if point is None and not np.isfinite(theta).all():
        nothing = Identifiability(problem.names, np.zeros((theta.size, theta.size)))
        return Estimate(problem.prior, "diverged", n_evals, nothing, problem=problem, **fields)
    point = quadratic_model(problem, theta) if point is None else point
    prior = problem.prior.information
    data = Identifiability(problem.names, point.normal - prior)
    local, determinant, distance, is_inside = assess_optimum(point.normal, point.gradient, theta, problem.bounds)
    is_inside = is_inside and determinant > SAFE
    is_finite = True
    if not is_inside:
        local, is_finite = covariance_of_free(problem.bounds, point.normal)
        distance = distance_to_optimum(point, problem.bounds)
    variance = noise_of(problem, point)
    status: Status = outcome
    if not own_objective and outcome != "diverged":
        near = distance <= max(CLOSE * variance**0.5, ROUNDING_DISTANCE)
        status = "converged" if near else "max_steps" if outcome == "converged" else outcome
    if outcome != "diverged" and not is_finite:
        status = "not_identifiable"
    checks = PASSED
    is_plain = variance == 1.0 and determinant > SEPARATE and problem.n_values > VALUES_A_PARAMETER * theta.size
    if status == "converged" and not own_objective:
        check = _check_ranges if is_plain else partial(_check_optimum, point, test)
        checks = check(problem, local, variance)
        status = checks.status
    if status in ("converged", "approximate") and not is_inside:
        status = "at_bound" if rests_on_bound(problem.bounds, theta, local) else status
    total = local if cov is None else cov
    if variance > 1.0 and not own_objective and is_finite:
        total = total + covariance_of_free(problem.bounds, data.information / variance + prior)[0] - local
    return Estimate(
        Belief(theta, total),
        status,
        n_evals,
        data,
        n_checks=checks.n_evals,
        distance=float("nan") if own_objective else distance,
        profile=checks.profile,
        better=checks.better,
        weak=checks.weak,
        problem=problem,
        **fields,
    )


def compare_with_descent(problem: Problem, estimate: Estimate) -> Estimate:
    """Compare an optimum that a method reached on its own way with that of a descent from the start.

    A local optimum whose residuals look like noise is not searched for elsewhere: the cheapest other way shows some.
    """
    if estimate.status != "converged":
        return estimate
    other = descend_from_start(problem)
    reached = float(problem.objective(estimate.belief.mean[None])[0])
    n_checks = estimate.n_checks + other.n_evals + 1
    if not reached - other.objective > least_improvement(noise_of(problem, other)):
        return replace(estimate, n_checks=n_checks)
    return replace(estimate, status="local_optimum", better=other.theta, n_checks=n_checks)


@dataclass(frozen=True, slots=True)
class _Checks:
    """Result of the checks of an optimum, and the passes they took."""

    status: Status
    n_evals: int = 0
    profile: Profile | None = None
    better: Array | None = None
    weak: tuple[str, ...] = ()


PASSED = _Checks("converged")


def _check_optimum(point: Point, test: OptimumTest | None, problem: Problem, cov: Array, variance: float) -> _Checks:
    """Search for a better optimum where noise does not explain the misfit, and profile the likelihood where curvature
    may not describe it."""
    test = check_optima(problem, [point], np.array([variance]))[0] if test is None else test
    if test.better is not None:
        return _Checks("local_optimum", test.n_evals, better=test.better.theta)
    if not test.is_bent:
        return _check_ranges(problem, cov, variance, test.n_evals)
    profile = profile_intervals(problem, point, cov, variance)
    status: Status = "weakly_identifiable" if profile.without_limit else "converged"
    if profile.better is not None:
        status = "local_optimum"
    return _Checks(status, test.n_evals + profile.n_evals, profile, profile.better, profile.without_limit)


def _check_ranges(problem: Problem, cov: Array, variance: float, passes: int = 0) -> _Checks:
    """Check for parameters without a prior that keep most of their declared range.

    In plain floats: every fit runs this, and NumPy on two numbers takes a tenth of the oscillator's time.
    """
    prior_var = problem.prior.cov.diagonal().tolist()
    var = cov.diagonal().tolist()
    weak = tuple(
        name
        for name, (low, high), prior_v, v in zip(problem.names, problem.bounds.tolist(), prior_var, var, strict=True)
        if prior_v == float("inf") and low < high and WIDE**2 * v * variance > (high - low) ** 2
    )
    if weak:
        return _Checks("weakly_identifiable", passes, weak=weak)
    return _Checks("converged", passes) if passes else PASSED


def rests_on_bound(bounds: Array, theta: Array, cov: Array) -> bool:
    """Check for a free parameter that rests on a bound, to a thousandth of its standard deviation."""
    for (low, high), value, variance in zip(bounds.tolist(), theta.tolist(), cov.diagonal().tolist(), strict=True):
        margin = AT_BOUND_SD * min(variance, 1e300) ** 0.5
        if not low + margin < value < high - margin and low < high:
            return True
    return False
