"""Estimate and its report, and the protocol of every estimator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

from hdt_core.estimation.fit import Fit, Identifiability, covariance_of_free
from hdt_core.estimation.optimum_checks import Profile
from hdt_core.estimation.problem import Array, Belief, Problem

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Status = Literal[
    "converged", "at_bound", "max_steps", "approximate", "local_optimum", "weakly_identifiable", "not_identifiable",
    "diverged",
]  # fmt: skip

LEAST_CORRELATION = 0.1  # correlations below this are not reported, as by lmfit
MEANING = {
    "adequate": "model and sigma explain the record",
    "lack_of_fit": "residuals larger than sigma allows, or following one another: model or sigma is wrong",
    "sigma_too_large": "residuals smaller than sigma allows: sigma is declared too large",
    "untested": "no degrees of freedom to test the fit with",
}


@dataclass(frozen=True)
class Estimate:
    """A posterior and how it was reached. The status of a fit is a value, not an exception.

    Parameters
    ----------
    belief : Belief
        Mean (n,) and covariance (n, n) of the parameters after the samples, prior included.
    status : Status
        `converged`: an optimum of the method's objective, to a thousandth of a standard deviation, and none better is
        known; `at_bound`: a parameter rests on its limit, its interval is one-sided at best; `max_steps`: stopped
        before it settled; `approximate`: by the method's nature no optimum; `local_optimum`: settled
        where a better optimum is known, see `better`; `weakly_identifiable`: an optimum, but the data leave a
        parameter's interval open; `not_identifiable`: they leave a direction open that the prior does not close;
        `diverged`: no finite answer, the belief is the prior.
    n_evals : int
        Passes over the record by the model, derivatives counted as passes, until the method stopped.
    identifiability : Identifiability
        Information of the data alone.
    path : array (k, n) or None
        The estimate after each sample, for methods that go through them in order.
    path_sd : array (k, n) or None
        Standard deviations along the path.
    method : str
        The estimator's name, and what finished its estimate where that is another.
    distance : float
        From the optimum, in standard deviations: Newton's decrement. NaN where it is not known.
    profile : Profile or None
        Profile intervals, where curvature may not give them.
    better : array (n,) or None
        A point of a lower objective than this estimate's, where one is known.
    n_checks : int
        Passes of the checks: the search for a better optimum, profiles.
    weak : tuple of str
        Parameters on which the data set no limit, or that keep most of their declared range: do not extrapolate with
        them beyond the recorded conditions.
    innovations : array (k, m) or None
        Of a filter whose states or parameters move, each over its standard deviation.
    """

    belief: Belief
    status: Status
    n_evals: int
    identifiability: Identifiability
    path: Array | None = None
    path_sd: Array | None = None
    method: str = ""
    distance: float = float("nan")
    profile: Profile | None = None
    better: Array | None = None
    n_checks: int = 0
    weak: tuple[str, ...] = ()
    innovations: Array | None = None
    problem: Problem | None = field(default=None, repr=False, compare=False)

    @cached_property
    def fit(self) -> Fit:
        """Residuals and statistics of the record at the estimate, computed on first use."""
        problem = self.problem
        n = self.belief.mean.size
        if problem is None:
            raise ValueError("an estimate without its problem has no residuals")
        if self.innovations is not None:
            return Fit(self.innovations, np.zeros(0, bool), np.empty((self.innovations.size, 0)), np.empty((0, 0)))
        residual = np.where(np.isnan(problem.measured), np.nan, -problem.residual(self.belief.mean))
        free = problem.bounds[:, 0] < problem.bounds[:, 1]
        slope = np.zeros((residual.size, n)) if self.status == "diverged" else problem.sensitivity(self.belief.mean)
        return Fit(residual, free, -slope, problem.prior.information)

    @cached_property
    def step_error(self) -> Array | None:
        """Shift of every parameter, in its standard deviations, with half the time step, (n,), to first
        order. None for a model without states, or one that is not declared with its rates."""
        problem = self.problem
        if problem is None or problem.half_steps is None or self.status == "diverged":
            return None
        coarse = replace(problem, kernels=None, trajectory=None)
        theta = self.belief.mean
        change = replace(coarse, transition=problem.half_steps).residual(theta) - coarse.residual(theta)
        slope = problem.sensitivity(theta)
        cov, _ = covariance_of_free(problem.bounds, slope.T @ slope + problem.prior.information)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.nan_to_num(-cov @ slope.T @ change.ravel() / self.belief.sd))

    def summary(self) -> str:
        """Format a report with the entries of lmfit's: status, statistics, parameters with three kinds of standard
        deviation, correlations."""
        fit = self.fit
        problem = self.problem
        lines = [
            "[[Fit]]",
            f"    method               = {self.method or '-'}",
            f"    status               = {self.status}",
            f"    distance to optimum  = {self.distance:.2g} standard deviations",
            f"    model evaluations    = {self.n_evals}, and {self.n_checks} to question the answer",
            f"    values               = {fit.n_values}",
            f"    free parameters      = {fit.n_free}",
            f"    degrees of freedom   = {fit.degrees}",
            f"    chi-square           = {fit.chi2:.6g}",
            f"    reduced chi-square   = {fit.reduced_chi2:.6g}",
            f"    Akaike criterion     = {fit.aic:.6g}",
            f"    Bayesian criterion   = {fit.bic:.6g}",
            f"    fit                  = {fit.verdict}: {MEANING[fit.verdict]}",
            "[[Parameters]]",
        ]
        starts = np.full(self.belief.mean.size, np.nan) if problem is None else problem.origin
        if self.step_error is not None:
            shift = np.abs(self.step_error).max(initial=0.0)
            lines.insert(-1, f"    error of the step    = {shift:.2g} standard deviations")
        lines += _parameters(self, starts) + _correlations(self)
        if self.weak:
            lines.append(f"[[Left open by the data]]\n    {', '.join(self.weak)}")
        if self.better is not None:
            point = ", ".join(
                f"{name} {v:.6g}" for name, v in zip(self.identifiability.names, self.better, strict=True)
            )
            lines.append(f"[[A better optimum]]\n    near {point}")
        return "\n".join(lines)

    def plot(self, axes: Axes) -> None:
        """Draw the normalised residuals of every output over the samples, with the band of two sigmas."""
        self.fit.plot(axes)

    def __getstate__(self) -> dict[str, Any]:
        """Drop the problem, whose functions may not be picklable, and keep its residuals."""
        results = {} if self.problem is None else {"fit": self.fit, "step_error": self.step_error}
        return {**self.__dict__, **results, "problem": None}


class Estimator(Protocol):
    """One method of estimation. Settings are its fields; it keeps no state between calls."""

    @property
    def name(self) -> str:
        """Short name, as in a table."""
        ...

    def estimate(self, problem: Problem) -> Estimate:
        """Estimate the problem's parameters."""
        ...


def estimate_each(method: Estimator, problem: Problem) -> list[Estimate]:
    """Estimate each problem of a batch: side by side where the method has an `estimate_each`, else one by one.

    One by one, parameters without a prior start from the last estimate that converged: a start and no prior.
    """
    together: Callable[[Problem], list[Estimate]] | None = getattr(method, "estimate_each", None)
    if together is not None:
        return together(problem)
    prior = problem.prior
    estimates = list[Estimate]()
    for b in range(problem.n_problems):
        estimates.append(method.estimate(problem.single(b).with_prior(prior)))
        if estimates[-1].status == "converged":
            mean = np.where(np.isinf(prior.sd), estimates[-1].belief.mean, prior.mean)
            prior = Belief(mean, prior.cov)
    return estimates


def _parameters(estimate: Estimate, starts: np.ndarray) -> list[str]:
    """Format each parameter with its standard deviations and profile interval."""
    is_filter = estimate.innovations is not None
    n = estimate.belief.mean.size
    fit = estimate.fit
    none = np.full(n, np.nan)
    scaled_sd, sandwich_sd = (none, none) if is_filter else (fit.scaled_sd, fit.sandwich_sd)
    width = max((len(name) for name in estimate.identifiability.names), default=0)
    lines = []
    for i, name in enumerate(estimate.identifiability.names):
        mean = float(estimate.belief.mean[i])
        sd = float(estimate.belief.sd[i])
        share = f" ({100.0 * sd / abs(mean):.2f} %)" if mean and np.isfinite(sd) else ""
        lines.append(
            f"    {name:<{width}}  {mean:.8g} +/- {sd:.4g}{share}, scaled {scaled_sd[i]:.4g}, "
            f"sandwich {sandwich_sd[i]:.4g} (init {starts[i]:.6g})"
        )
        if estimate.profile is not None:
            low, high = estimate.profile.interval[i]
            lines.append(f"    {'':<{width}}  95 % by profile: {low:.6g} to {high:.6g}")
    return lines


def _correlations(estimate: Estimate) -> list[str]:
    names = estimate.identifiability.names
    cov = estimate.belief.cov
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = cov / np.outer(estimate.belief.sd, estimate.belief.sd)
    pairs = [(i, j) for i in range(len(names)) for j in range(i) if abs(correlation[i, j]) >= LEAST_CORRELATION]
    if not pairs:
        return []
    pairs.sort(key=lambda pair: -abs(correlation[pair]))
    lines = [f"    C({names[j]}, {names[i]}) = {correlation[i, j]:+.4f}" for i, j in pairs]
    return [f"[[Correlations]] (below {LEAST_CORRELATION:g} not shown)", *lines]
