"""Fisher information of the data about the parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdt_core.estimation.problem import Array, Problem

SINGULAR = 1e14  # condition of the scaled information from which central differences are no better than a zero


@dataclass(frozen=True, slots=True)
class Identifiability:
    r"""Fisher information of the data alone, without the prior, about the estimate.

    .. math:: \mathcal I = \sum_i \left(\frac{\partial y_i}{\partial\theta}\right)^T \Sigma^{-1}
              \frac{\partial y_i}{\partial\theta}

    Parameters
    ----------
    names : tuple of str
    information : array (n, n)
        Fisher information, per product of the parameters' units.

    References
    ----------
    .. [1] S. M. Kay, Fundamentals of Statistical Signal Processing: Estimation Theory, 1993, chapter 3.
    """

    names: tuple[str, ...]
    information: Array

    @property
    def scaled_information(self) -> Array:
        """Information with unit diagonal: free of units, so that its condition compares directions and not scales."""
        size = np.sqrt(np.maximum(np.diag(self.information), 0.0))
        size = np.where(size > 0.0, size, 1.0)
        return np.asarray(self.information / np.outer(size, size))

    @property
    def condition(self) -> float:
        """Largest over smallest eigenvalue of the scaled information; infinite with an unobservable direction."""
        values = np.linalg.eigvalsh(self.scaled_information)
        return float(values[-1] / values[0]) if values[0] > 0.0 else float("inf")

    @property
    def identifiable(self) -> bool:
        """Whether every direction is observable, to the precision of a numerical derivative."""
        return self.condition < SINGULAR

    @property
    def bound_sd(self) -> Array:
        """Cramér-Rao bound of the standard deviations, (n,): infinite for a parameter in an unobservable direction."""
        return np.sqrt(np.diag(invert_information(self.information)[0]))

    @property
    def correlation(self) -> Array:
        """Correlation of the estimates, (n, n); NaN in the rows of unidentifiable parameters."""
        cov = invert_information(self.information)[0]
        with np.errstate(invalid="ignore"):
            return np.asarray(cov / np.sqrt(np.outer(np.diag(cov), np.diag(cov))))

    @property
    def weakest(self) -> dict[str, float]:
        """The least observable direction, in units of each parameter's own precision."""
        vector = np.linalg.eigh(self.scaled_information)[1][:, 0]
        return dict(zip(self.names, (float(v) for v in vector), strict=True))


def fisher(problem: Problem, theta: Array) -> Identifiability:
    """Compute the information of the measured values about `theta` (n,), at `theta`."""
    slope = problem.sensitivity(theta)
    return Identifiability(problem.names, slope.T @ slope)


def invert_information(information: Array) -> tuple[Array, bool]:
    """Invert an information matrix (n, n); return also whether every direction is observable.

    Parameters in an unobservable direction get an infinite variance.
    """
    size = np.sqrt(np.maximum(information.diagonal(), 0.0))
    size[size == 0.0] = 1.0
    scales = size[:, None] * size
    values, vectors = np.linalg.eigh(information / scales)
    observable = values > values[-1:] / SINGULAR
    if observable.all():
        return (vectors / values) @ vectors.T / scales, True
    cov = (vectors[:, observable] / values[observable]) @ vectors[:, observable].T / scales
    unobservable = (np.abs(vectors[:, ~observable]) > 1e-6).any(axis=1)
    cov[unobservable] = 0.0
    cov[:, unobservable] = 0.0
    cov[unobservable, unobservable] = np.inf
    return cov, False


def covariance_of_free(bounds: Array, total: Array) -> tuple[Array, bool]:
    """Compute the covariance of the free parameters, zero for fixed ones, and whether it is finite."""
    free = bounds[:, 0] < bounds[:, 1]
    if free.all():
        return invert_information(total)
    cov, rows = np.zeros_like(total), np.ix_(free, free)
    cov[rows], is_finite = invert_information(total[rows]) if free.any() else (0.0, True)
    return cov, is_finite
