"""What an estimator answers, and the contract every one of them keeps."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

from hdt_core.estimation.descent import Point, descend, distance_to_optimum, linearised
from hdt_core.estimation.doubts import Profile, better_optimum, is_bent, profiled
from hdt_core.estimation.fit import Fit, noise_variance
from hdt_core.estimation.identifiability import SAFE, Identifiability, inverted
from hdt_core.estimation.kernels.damped import judged
from hdt_core.estimation.problem import Array, Belief, Problem
from hdt_core.estimation.summary import draw, fit_report

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Status = Literal[
    "converged",
    "at_bound",
    "max_steps",
    "approximate",
    "local_optimum",
    "weakly_identifiable",
    "not_identifiable",
    "diverged",
]
CLOSE = 5e-4  # standard deviations to the optimum of the quadratic model: half of what `converged` promises
APART = 0.5  # scaled determinant from which parameters are told apart well
MANY = 100  # values a parameter: with parameters well apart, the likelihood is a bell
WIDE = 6.0  # standard deviations: where the declared range holds fewer, the data have hardly narrowed it


@dataclass(frozen=True)
class Estimate:
    """An answer and how it was reached. How a fit ended is a value, not an exception.

    Parameters
    ----------
    belief : Belief
        Mean (n,) and covariance (n, n) of the parameters after the samples, prior included.
    status : Status
        `converged`: an optimum of the method's objective, to a thousandth of a standard deviation, and none better is
        known; `at_bound`: a parameter rests on its limit, its interval is one-sided at best; `max_steps`: stopped
        before it settled; `approximate`: an answer that is no optimum by the method's nature; `local_optimum`: settled
        where a better optimum is known, see `better`; `weakly_identifiable`: an optimum, but the data leave a
        parameter's interval open; `not_identifiable`: they leave a direction open that the prior does not close;
        `diverged`: no finite answer, the belief is the prior.
    n_evals : int
        Passes over the record by the model, derivatives counted as passes, until the method stopped.
    identifiability : Identifiability
        What the data alone say.
    path : array (k, n) or None
        The estimate after each sample, for methods that go through them in order.
    path_sd : array (k, n) or None
        Standard deviations along the path.
    method : str
        The estimator's name.
    distance : float
        From the optimum, in standard deviations: Newton's decrement. NaN where it is not known.
    profile : Profile or None
        Profile intervals, where curvature is a doubtful witness of them.
    better : array (n,) or None
        A point of a lower objective than this estimate's, where one is known.
    n_checks : int
        Passes spent on questioning the answer: the search for a better optimum, profiles.
    weak : tuple of str
        Parameters on which the data set no limit, or that keep most of their declared range: what is reckoned with them
        away from the conditions recorded is not known.
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
        """The record against the model at the estimate; made on first use."""
        problem, n = self.problem, self.belief.mean.size
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
        """Shift of every parameter, in its standard deviations, were the model stepped twice as finely, (n,); to first
        order. None for a model without states, or one that is not declared with its rates."""
        problem = self.problem
        if problem is None or problem.refined is None or self.status == "diverged":
            return None
        coarse, theta = replace(problem, kernels=None), self.belief.mean
        change = replace(coarse, transition=problem.refined).residual(theta) - coarse.residual(theta)
        slope = problem.sensitivity(theta)
        cov, _ = _spread(problem.bounds, slope.T @ slope + problem.prior.information)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.nan_to_num(-cov @ slope.T @ change.ravel() / np.sqrt(cov.diagonal())))

    def summary(self) -> str:
        """Report in words and numbers, with what lmfit's has."""
        return fit_report(self)

    def plot(self, axes: Axes) -> None:
        """Draw the normalised residuals of every output over the samples, with the band of two sigmas."""
        draw(self.fit, axes)

    def __getstate__(self) -> dict[str, Any]:
        """Leave the problem behind, whose functions may not travel; take its residuals along."""
        made = {} if self.problem is None else {"fit": self.fit, "step_error": self.step_error}
        return {**self.__dict__, **made, "problem": None}


class Estimator(Protocol):
    """One question, one answer. Settings are the estimator's fields; nothing is kept from one call to the next."""

    @property
    def name(self) -> str:
        """Short name, as in a table."""
        ...

    def estimate(self, problem: Problem) -> Estimate:
        """Answer the problem."""
        ...


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
    return conclude(problem, at.theta, "converged" if at.settled else "max_steps", at.n_evals, at=at, **more)


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
        The method's own covariance; the inverse of data and prior information when not given.
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
        own, told = _spread(problem.bounds, at.normal)
        distance = distance_to_optimum(at, problem.bounds)
        n_free = int(np.count_nonzero(problem.bounds[:, 0] < problem.bounds[:, 1]))
    variance = noise_variance(at.objective, problem.n_values, n_free)
    status: Status = reached
    if not own_objective and reached != "diverged":
        near = distance <= CLOSE * max(variance, 1.0) ** 0.5
        status = "converged" if near else "max_steps" if reached == "converged" else reached
    if reached != "diverged" and not told:
        status = "not_identifiable"
    doubt = NO_DOUBT
    plain = variance == 1.0 and determinant > APART and problem.n_values > MANY * theta.size
    if status == "converged" and not own_objective:
        doubt = _narrowed(problem, own, variance) if plain else _questioned(problem, at, own, variance)
        status = doubt.status
    if status in ("converged", "approximate") and not inside:
        status = "at_bound" if _rests_on_bound(problem.bounds, theta, own, held=False) else status
    return Estimate(
        Belief(theta, own if cov is None else cov),
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


def _spread(bounds: Array, total: Array) -> tuple[Array, bool]:
    """Covariance of all information there is, none for held parameters, and whether it is finite."""
    free = bounds[:, 0] < bounds[:, 1]
    if free.all():
        return inverted(total)
    cov, rows = np.zeros_like(total), np.ix_(free, free)
    cov[rows], told = inverted(total[rows]) if free.any() else (0.0, True)
    return cov, told


def _rests_on_bound(bounds: Array, theta: Array, cov: Array, *, held: bool = True) -> bool:
    """Whether a parameter is within a thousandth of its standard deviation of a limit; held ones count if `held`."""
    for (low, high), value, variance in zip(bounds.tolist(), theta.tolist(), cov.diagonal().tolist(), strict=True):
        margin = 1e-3 * min(variance, 1e300) ** 0.5
        if not low + margin < value < high - margin and (held or low < high):
            return True
    return False
