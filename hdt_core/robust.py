"""Robust statistics: standard deviation by the median of absolute deviations, error of a median, Huber's weights.

References
----------
.. [1] P. J. Huber and E. M. Ronchetti, Robust Statistics, 2nd ed., 2009, sections 1.2 and 4.5.
"""

from typing import Any, TypeVar

import numpy as np
import polars as pl
from numpy.typing import NDArray

Array = NDArray[Any]
Column = TypeVar("Column", float, Array, pl.Expr)

MAD_TO_SD = 1.4826
"""Standard deviation of normal values over the median of their absolute deviations."""
MEDIAN_SD = 1.2533
"""Standard deviation of a median of normal values over that of their mean."""
Z_90 = 1.645
"""Standard deviations on either side of a normal mean that hold 90 %; 95 % lie below the upper one."""
HUBER_K = 1.345
"""Standard deviations from which a value loses weight: 95 % efficient on normal errors."""


def spread(deviations: Array) -> float:
    """Estimate a standard deviation from deviations about a known centre, without NaN."""
    return float(MAD_TO_SD * np.nanmedian(np.abs(deviations)))


def spread_expr(deviations: pl.Expr) -> pl.Expr:
    """Build `spread` as an expression."""
    return deviations.abs().median() * MAD_TO_SD


def median_error(n: Column) -> Column:
    """Compute the standard error of the median of n normal values, over their standard deviation."""
    error: Column = MEDIAN_SD / n**0.5
    return error


def huber_weights(deviation: Array, scale: Array | float, k: float = HUBER_K) -> Array:
    """Compute Huber's weights: 1 within `k` of the `scale`, less beyond.

    Parameters
    ----------
    deviation : array, shape (n,)
        Absolute deviations.
    scale : array, shape (n,), or float
        Standard deviation of good values; zero counts as very small.
    """
    return np.asarray(1.0 / np.maximum(1.0, deviation / (k * np.maximum(scale, 1e-9))))


def group_means(values: Array, group: Array, weight: Array) -> tuple[Array, Array]:
    """Compute weighted means of the columns of values (n, p) by group, and the groups' weights. (g, p), (g,)"""
    total = np.maximum(np.bincount(group, weight), 1e-12)
    return np.stack([np.bincount(group, weight * column) / total for column in values.T], axis=1), total


def huber_slopes(x: Array, y: Array, ridge: Array, steps: int, k: float = HUBER_K, group: Array | None = None) -> Array:
    """Regress y (n,) on x (n, p) with Huber's weights, each group about a level of its own; `ridge` (p, p) keeps
    constant columns solvable. (p,)"""
    weight: Array = np.ones(len(y))
    slopes: Array = np.zeros(x.shape[1])
    for _ in range(steps):
        rows = np.column_stack([x, y])
        if group is not None:
            rows -= group_means(rows, group, weight)[0][group]
        dx = rows[:, :-1]
        dy = rows[:, -1]
        slopes = np.linalg.solve(dx.T @ (weight[:, None] * dx) + ridge, dx.T @ (weight * dy))
        residual = np.abs(dy - dx @ slopes)
        weight = huber_weights(residual, spread(residual), k)
    return slopes
