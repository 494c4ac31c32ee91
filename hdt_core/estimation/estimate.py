"""What an estimator answers, and the contract every one of them keeps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from hdt_core.estimation.identifiability import SAFE, Identifiability, fisher, inverted
from hdt_core.estimation.kernels.damped import inverse_spd
from hdt_core.estimation.problem import Array, Belief, Problem

Status = Literal["converged", "at_bound", "max_steps", "not_identifiable", "diverged"]


@dataclass(frozen=True, slots=True)
class Estimate:
    """An answer and how it was reached. How a fit ended is a value, not an exception.

    Parameters
    ----------
    belief : Belief
        Mean (n,) and covariance (n, n) of the parameters after the samples, prior included.
    status : Status
        `converged`; `at_bound`: a parameter rests on its limit, its interval is one-sided at best; `max_steps`: stopped
        before it settled; `not_identifiable`: the data leave a direction open that the prior does not close;
        `diverged`: no finite answer, the belief is the prior.
    n_evals : int
        Passes over the record by the model, derivatives counted as passes.
    identifiability : Identifiability
        What the data alone say.
    path : array (k, n) or None
        The estimate after each sample, for methods that go through them in order.
    path_sd : array (k, n) or None
        Standard deviations along the path.
    """

    belief: Belief
    status: Status
    n_evals: int
    identifiability: Identifiability
    path: Array | None = None
    path_sd: Array | None = None


class Estimator(Protocol):
    """One question, one answer. Settings are the estimator's fields; nothing is kept from one call to the next."""

    @property
    def name(self) -> str:
        """Short name, as in a table."""
        ...

    def estimate(self, problem: Problem) -> Estimate:
        """Answer the problem."""
        ...


def conclude(
    problem: Problem,
    theta: Array,
    reached: Status,
    n_evals: int,
    *,
    information: Array | None = None,
    cov: Array | None = None,
    path: Array | None = None,
    path_sd: Array | None = None,
) -> Estimate:
    """Turn a point into an estimate: covariance, what the data told, and the status that serves the reader best.

    Parameters
    ----------
    theta : array (n,)
        Where the method stopped.
    reached : Status
        How the method itself says it ended; bounds and identifiability may overrule `converged`.
    information : array (n, n), optional
        Fisher information of the data at `theta`; computed when not given.
    cov : array (n, n), optional
        The method's own covariance; the inverse of data and prior information when not given.
    """
    if not np.isfinite(theta).all():
        nothing = Identifiability(problem.names, np.zeros((theta.size, theta.size)))
        return Estimate(problem.prior, "diverged", n_evals, nothing, path, path_sd)
    seen = fisher(problem, theta).information if information is None else information
    told_by = Identifiability(problem.names, seen)
    total = seen + problem.prior.information
    own, determinant = inverse_spd(total)
    if determinant > SAFE and not _rests_on_bound(
        problem.bounds, theta, own
    ):  # the common case, quickly: nothing to overrule
        return Estimate(Belief(theta, own if cov is None else cov), reached, n_evals, told_by, path, path_sd)
    own, told = _spread(problem.bounds, total)
    status = reached
    if reached != "diverged" and not told:
        status = "not_identifiable"
    elif reached == "converged" and _rests_on_bound(problem.bounds, theta, own, held=False):
        status = "at_bound"
    return Estimate(Belief(theta, own if cov is None else cov), status, n_evals, told_by, path, path_sd)


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
