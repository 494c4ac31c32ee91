"""Intervals for rates, shares, points and sums over aircraft whose flights are not independent.

Exact intervals for counts (Garwood, Clopper and Pearson), their counts divided by the design effect: how much more the
count scatters from aircraft to aircraft than independent events would [1].

References
----------
.. [1] J. N. K. Rao, A. J. Scott, A simple method for the analysis of clustered binary data, Biometrics 48, 1992.
.. [2] R. Brookmeyer, J. Crowley, A confidence interval for the median survival time, Biometrics 38, 1982.
"""

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Interval:
    """A value with its interval; ends that the data do not bound are None."""

    value: float
    low: float | None
    high: float | None


def rate(counts: ArrayLike, exposure: ArrayLike, confidence: float) -> Interval:
    """Events over exposure, a cluster an entry; exact for a Poisson count (Garwood).

    Examples
    --------
    >>> found = rate([0, 0, 0], [100.0, 100.0, 100.0], 0.95)
    >>> found.value, found.low, round(found.high * 300, 3)
    (0.0, 0.0, 3.689)
    """
    y = np.asarray(counts, dtype=float)
    x = np.asarray(exposure, dtype=float)
    total = float(y.sum())
    over = float(x.sum())
    tail = (1.0 - confidence) / 2.0
    effect = _design_effect(y, x, total)
    n = total / effect
    low = 0.5 * float(stats.chi2.ppf(tail, 2.0 * n)) if n else 0.0
    high = 0.5 * float(stats.chi2.ppf(1.0 - tail, 2.0 * n + 2.0))
    return Interval(total / over, low * effect / over, high * effect / over)


def share(hits: ArrayLike, trials: ArrayLike, confidence: float) -> Interval:
    """Hits over asked, a cluster an entry; exact for a binomial count (Clopper and Pearson).

    Examples
    --------
    >>> found = share([4], [4], 0.95)
    >>> found.value, round(found.low, 3), found.high
    (1.0, 0.398, 1.0)
    """
    y = np.asarray(hits, dtype=float)
    n = np.asarray(trials, dtype=float)
    p = y.sum() / n.sum()
    alpha = 1.0 - confidence
    effect = _design_effect(y, n, n.sum() * p * (1.0 - p))
    k = y.sum() / effect
    m = n.sum() / effect
    low = float(stats.beta.ppf(alpha / 2.0, k, m - k + 1.0)) if k > 0.0 else 0.0
    high = float(stats.beta.ppf(1.0 - alpha / 2.0, k + 1.0, m - k)) if k < m else 1.0
    return Interval(float(p), low, high)


def point(values: ArrayLike, at_least: ArrayLike, level: float, confidence: float) -> Interval | None:
    """A point of a distribution of which some values are only known to be so large or larger (Kaplan and Meier).

    Its interval holds the points at which the survival curve's own could be the level [2]; ends that too few values
    leave open, and a point that the curve does not reach, are None.
    """
    data = stats.CensoredData.right_censored(np.asarray(values, dtype=float), np.asarray(at_least, dtype=bool))
    curve = stats.ecdf(data).sf
    with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore"):  # ends that are open: told as None
        band = curve.confidence_interval(confidence, method="log-log")
    middle, low, high = (_reached(c.quantiles, c.probabilities, 1.0 - level) for c in (curve, band.low, band.high))
    return None if middle is None else Interval(middle, low, high)


def ratio(sums: ArrayLike, exposure: ArrayLike, confidence: float) -> Interval:
    """A sum, such as of money, over exposure; by how it scatters from cluster to cluster (Student's t)."""
    y = np.asarray(sums, dtype=float)
    x = np.asarray(exposure, dtype=float)
    value = y.sum() / x.sum()
    if y.size < 2:
        return Interval(float(value), None, None)
    half = float(stats.t.ppf(0.5 + confidence / 2.0, y.size - 1) * np.sqrt(_scatter(y, x)) / x.sum())
    return Interval(float(value), float(value) - half, float(value) + half)


def _reached(values: Array, surviving: Array, share: float) -> float | None:
    """First value at which no more than a share survives."""
    below = np.flatnonzero(surviving <= share + 1e-12)
    return float(values[below[0]]) if below.size else None


def _design_effect(y: Array, x: Array, independent: float) -> float:
    """Variance of the total between clusters over that of independent events; never below one."""
    return max(1.0, _scatter(y, x) / independent) if y.size > 1 and independent > 0.0 else 1.0


def _scatter(y: Array, x: Array) -> float:
    """Variance of sum(y) given sum(x), by its scatter between clusters."""
    residual = y - x * (y.sum() / x.sum())
    return float(residual @ residual * y.size / (y.size - 1))
