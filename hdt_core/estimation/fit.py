"""How well a record determines the parameters and the model fits it: Fisher information, residuals, chi-square,
information criteria, and deviations that allow for a sigma declared wrong."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt
from scipy.special import chdtr, chdtrc, chdtri

from hdt_core.estimation.problem import Array, Problem

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SINGULAR = 1e14  # condition of the scaled information from which central differences are no better than a zero
Verdict = Literal["adequate", "lack_of_fit", "sigma_too_large", "untested"]
CHANCE = 1e-3  # of a record as declared to be called anything but adequate, on either side
ROUNDING = 1e-6  # of sigma, squared: below, the pattern of residuals is that of rounding and of the last step
STRUCTURE = 4.0  # standard deviations of the residuals' serial correlation


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
    size, values, vectors, observable = scaled_eigen(information)
    scales = size[:, None] * size
    if observable.all():
        return (vectors / values) @ vectors.T / scales, True
    cov = (vectors[:, observable] / values[observable]) @ vectors[:, observable].T / scales
    unobservable = (np.abs(vectors[:, ~observable]) > 1e-6).any(axis=1)
    cov[unobservable] = 0.0
    cov[:, unobservable] = 0.0
    cov[unobservable, unobservable] = np.inf
    return cov, False


def scaled_eigen(information: Array) -> tuple[Array, Array, Array, npt.NDArray[np.bool_]]:
    """Scale an information matrix (n, n) to unit diagonal: the root of its diagonal, eigenvalues and vectors of the
    scaled one, and which directions are observable."""
    size = np.sqrt(np.maximum(information.diagonal(), 0.0))
    size[size == 0.0] = 1.0
    values, vectors = np.linalg.eigh(information / (size[:, None] * size))
    return size, values, vectors, values > values[-1:] / SINGULAR


def covariance_of_free(bounds: Array, total: Array) -> tuple[Array, bool]:
    """Compute the covariance of the free parameters, zero for fixed ones, and whether it is finite."""
    free = bounds[:, 0] < bounds[:, 1]
    if free.all():
        return invert_information(total)
    cov = np.zeros_like(total)
    rows = np.ix_(free, free)
    cov[rows], is_finite = invert_information(total[rows]) if free.any() else (0.0, True)
    return cov, is_finite


@dataclass(frozen=True, slots=True)
class Fit:
    r"""The record against the model at the estimate.

    Parameters
    ----------
    residuals : array (k, m)
        (measured - model) / sigma, NaN where missing. Of a filter whose states or parameters move: its innovations,
        each over its own standard deviation.
    free : array (n,) of bool
        Parameters that the record was fitted with, not held. None for innovations.
    slope : array (k * m, n)
        d residual / d parameter; zero where missing. Empty for innovations.
    prior_information : array (n, n)

    References
    ----------
    .. [1] M. Newville et al., LMFIT, Zenodo 2014: the definitions of its fit report are those here.
    .. [2] H. White, Maximum likelihood estimation of misspecified models, Econometrica 50(1), 1982.
    """

    residuals: Array
    free: npt.NDArray[np.bool_]
    slope: Array
    prior_information: Array

    @property
    def n_free(self) -> int:
        """Free parameters."""
        return int(np.count_nonzero(self.free))

    @property
    def n_values(self) -> int:
        """Values measured."""
        return int(np.count_nonzero(~np.isnan(self.residuals)))

    @property
    def chi2(self) -> float:
        """Sum of squared residuals, each over its sigma."""
        return float(np.nansum(self.residuals**2))

    @property
    def degrees(self) -> int:
        """Degrees of freedom: values less free parameters, not below 0."""
        return max(self.n_values - self.n_free, 0)

    @property
    def reduced_chi2(self) -> float:
        """Chi-square over its degrees of freedom: 1 where model and sigma are right; NaN without any."""
        return self.chi2 / self.degrees if self.degrees else float("nan")

    @property
    def p_value(self) -> float:
        """Chance of a chi-square this large or larger, were the model and sigma right."""
        return float(chdtrc(self.degrees, self.chi2)) if self.degrees else float("nan")

    @property
    def aic(self) -> float:
        """Akaike's criterion, sigma's scale unknown: n ln(chi2 / n) + 2 p. Minus infinity for a perfect fit."""
        return self._log_mean_square() + 2.0 * self.n_free

    @property
    def bic(self) -> float:
        """Schwarz's criterion: n ln(chi2 / n) + p ln n."""
        return self._log_mean_square() + self.n_free * float(np.log(max(self.n_values, 1)))

    @property
    def serial_correlation(self) -> float:
        """Correlation of a residual with the next of its output, in standard deviations of pure noise's."""
        first = self.residuals[:-1]
        second = self.residuals[1:]
        pairs = ~np.isnan(first) & ~np.isnan(second)
        power = float(np.nanmean(self.residuals**2)) if self.n_values else 0.0
        if not 0.0 < power < np.inf or not pairs.any():
            return 0.0
        return float(np.sum((first * second)[pairs]) / power / np.sqrt(pairs.sum()))

    @property
    def verdict(self) -> Verdict:
        """`lack_of_fit`: residuals larger than sigma allows, or that follow one another; `sigma_too_large`: smaller
        than sigma allows; `untested`: no degrees of freedom; else `adequate`."""
        if not self.degrees:
            return "untested"
        has_structure = self.serial_correlation > STRUCTURE and self.reduced_chi2 > ROUNDING
        if self.p_value < CHANCE or not np.isfinite(self.chi2) or has_structure:
            return "lack_of_fit"
        return "sigma_too_large" if chdtr(self.degrees, self.chi2) < CHANCE else "adequate"

    @property
    def scaled_sd(self) -> Array:
        """Standard deviations (n,) if sigma's scale is what the residuals show: lmfit's and SciPy's curve_fit."""
        scale = self.reduced_chi2 if self.degrees and self.chi2 > 0.0 else 1.0
        data = self.slope.T @ self.slope
        return self._of_free(self._inverse(data / scale))

    @property
    def sandwich_sd(self) -> Array:
        """Standard deviations (n,) whatever the residuals' variances are, sample by sample: White's, with the factor
        n / (n - p). Infinite where the data leave a direction open."""
        bread = self._inverse(self.slope.T @ self.slope)
        pull = np.nan_to_num(self.residuals)[..., None] * self.slope.reshape(*self.residuals.shape, self.free.size)
        score = pull.sum(axis=1)
        filling = score.T @ score * (self.n_values / max(self.degrees, 1)) + self.prior_information
        if not np.isfinite(bread).all():
            return self._of_free(bread)
        return self._of_free(bread @ filling[np.ix_(self.free, self.free)] @ bread)

    def plot(self, axes: Axes) -> None:
        """Normalised residuals of every output over the samples."""
        for j, column in enumerate(self.residuals.T):
            axes.plot(column, ".", markersize=3, label=f"output {j + 1}")
        axes.axhspan(-2.0, 2.0, color="0.9", zorder=0)
        axes.axhline(0.0, color="0.5", linewidth=0.8)
        title = f"chi-square {self.chi2:.4g} of {self.degrees} degrees of freedom: {self.verdict}"
        axes.set(xlabel="sample", ylabel="(measured - model) / sigma", title=title)
        axes.legend()

    def _inverse(self, data: Array) -> Array:
        """Covariance of the free parameters from `data` information and the prior's."""
        return invert_information((data + self.prior_information)[np.ix_(self.free, self.free)])[0]

    def _of_free(self, cov: Array) -> Array:
        sd = np.zeros(self.free.size)
        sd[self.free] = np.sqrt(np.maximum(cov.diagonal(), 0.0))
        return sd

    def _log_mean_square(self) -> float:
        with np.errstate(divide="ignore"):
            return float(self.n_values * np.log(self.chi2 / self.n_values)) if self.n_values else 0.0


def noise_variance(chi2: float, n_values: int, n_free: int) -> float:
    """Variance of the noise over the declared: 1, unless chi-square contradicts that; then what chi-square shows."""
    degrees = n_values - n_free
    if degrees <= 0 or not chi2 < np.inf or chdtri(degrees, 1.0 - CHANCE) <= chi2 <= chdtri(degrees, CHANCE):
        return 1.0
    return chi2 / degrees
