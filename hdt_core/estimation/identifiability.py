"""What the data can tell about the parameters, and what they cannot: Fisher information."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdt_core.estimation.damped import inverse_spd
from hdt_core.estimation.problem import Array, Problem

SAFE = 1e-10  # a scaled determinant from which a Cholesky factor is as good as an eigenvalue decomposition
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
    def scaled(self) -> Array:
        """Information with unit diagonal: free of units, so that its condition compares directions and not scales."""
        size = np.sqrt(np.maximum(np.diag(self.information), 0.0))
        size = np.where(size > 0.0, size, 1.0)
        return np.asarray(self.information / np.outer(size, size))

    @property
    def condition(self) -> float:
        """Largest over smallest eigenvalue of the scaled information; infinite where a direction is unseen."""
        values = np.linalg.eigvalsh(self.scaled)
        return float(values[-1] / values[0]) if values[0] > 0.0 else float("inf")

    @property
    def identifiable(self) -> bool:
        """Whether every direction is seen by the data, to the precision of a numerical derivative."""
        return self.condition < SINGULAR

    @property
    def bound_sd(self) -> Array:
        """Cramér-Rao bound of the standard deviations, (n,): infinite for a parameter in an unseen direction."""
        return np.sqrt(np.diag(inverted(self.information)[0]))

    @property
    def correlation(self) -> Array:
        """Correlation of the estimates, (n, n); NaN in the rows of parameters the data cannot tell."""
        cov = inverted(self.information)[0]
        with np.errstate(invalid="ignore"):
            return np.asarray(cov / np.sqrt(np.outer(np.diag(cov), np.diag(cov))))

    @property
    def weakest(self) -> dict[str, float]:
        """The direction the data see least, in units of each parameter's own precision: what only moves together."""
        vector = np.linalg.eigh(self.scaled)[1][:, 0]
        return dict(zip(self.names, (float(v) for v in vector), strict=True))


def fisher(problem: Problem, theta: Array) -> Identifiability:
    """Information of the measured values about `theta` (n,), at `theta`."""
    slope = problem.sensitivity(theta)
    return Identifiability(problem.names, slope.T @ slope)


def inverted(information: Array) -> tuple[Array, bool]:
    """Inverse of an information matrix (n, n), and whether every direction was seen.

    Where one was not, parameters that lie in it get an infinite variance.
    """
    inverse, determinant = inverse_spd(information)
    if determinant > SAFE:
        return inverse, True
    size = np.sqrt(np.maximum(information.diagonal(), 0.0))
    size[size == 0.0] = 1.0
    scales = size[:, None] * size
    values, vectors = np.linalg.eigh(information / scales)
    if values[0] > values[-1] / SINGULAR:
        return (vectors / values) @ vectors.T / scales, True
    seen = values > max(values[-1], 0.0) / SINGULAR
    cov = (vectors[:, seen] / values[seen]) @ vectors[:, seen].T / scales
    lost = (np.abs(vectors[:, ~seen]) > 1e-6).any(axis=1)
    cov[lost] = 0.0
    cov[:, lost] = 0.0
    cov[lost, lost] = np.inf
    return cov, False


def covariance_of_free(bounds: Array, total: Array) -> tuple[Array, bool]:
    """Covariance of all information there is, none for held parameters, and whether it is finite."""
    free = bounds[:, 0] < bounds[:, 1]
    if free.all():
        return inverted(total)
    cov, rows = np.zeros_like(total), np.ix_(free, free)
    cov[rows], told = inverted(total[rows]) if free.any() else (0.0, True)
    return cov, told
