"""Inner loops of the compiled exchanger fits over sixteen flights side by side, for the vector registers: the
curve, its slope, and the sums of a Gauss-Newton step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np

from hdt_core.estimation.compiled import COMPILED
from hdt_core.estimation.problem import Array
from hdt_core.physics.effectiveness import MAX_TERMS, SERIES_TOLERANCE, SERIES_UNITS, contour_sums

LANES = 16  # flights at once: two registers of eight doubles, or four of four
TERMS, FEW_UNITS = 12, 8.0  # terms of the series, good to 3e-11 while the product of both sides' NTU is this or less
LARGER_UNITS = 32.0  # and the larger of the two this
FREELY = {"reassoc", "contract", "arcp", "nsz"}
F = TypeVar("F", bound=Callable[..., object])

if COMPILED:  # numba accelerates; nothing depends on it
    from numba import njit


def vectorised(function: F) -> F:
    """Compile with sums reordered for the vector registers; NaN and infinity keep their meaning.

    The machine code is kept on disk. Numba knows it is stale by this file alone: after changing what is imported here,
    remove the `__pycache__` beside it.
    """
    if not COMPILED:
        return function
    return cast("F", njit(cache=True, fastmath=FREELY, error_model="numpy")(function))


def _inlined(function: F) -> F:
    """Compile into the caller, whose loop can only then be vectorised."""
    return cast("F", njit(inline="always")(function)) if COMPILED else function


@vectorised
def _decay(x: float) -> float:
    """exp(-x) for 0 <= x < 40 from multiplications alone, which vectorise; absolute error below 1e-14."""
    y = -x / 64.0
    s = 1.0 + y / 8.0 * (1.0 + y / 9.0 * (1.0 + y / 10.0 * (1.0 + y / 11.0)))
    s = 1.0 + y * (
        1.0 + y / 2.0 * (1.0 + y / 3.0 * (1.0 + y / 4.0 * (1.0 + y / 5.0 * (1.0 + y / 6.0 * (1.0 + y / 7.0 * s)))))
    )
    s *= s
    s *= s
    s *= s
    s *= s
    s *= s
    return s * s


@_inlined
def _series(a: float, b: float) -> tuple[float, float]:
    """Effectiveness and its derivative by ln UA, as `physics.effectiveness` has them."""
    t_a, t_b = _decay(a), _decay(b)
    p, q = 1.0 - t_a, 1.0 - t_b
    total, slope = 0.0, 0.0
    for n in range(TERMS):
        total += p * q
        per = 1.0 / (n + 1.0)
        t_a *= a * per
        slope += t_a * t_b
        t_b *= b * per
        p -= t_a
        q -= t_b
    return total / b, slope


_contour_sums: Any = vectorised(contour_sums)  # the same equation, one number at a time


@vectorised
def _any_units(a: float, b: float) -> tuple[float, float]:
    """The same for any number of transfer units."""
    few, many = min(a, b), max(a, b)
    if few > SERIES_UNITS:
        short, unequal = _contour_sums(few, many)
        return (few - short) / b, few * unequal / b
    t_a, t_b = np.exp(-a), np.exp(-b)
    p, q = -np.expm1(-a), -np.expm1(-b)
    total, slope, added, n = 0.0, 0.0, 1.0, 0
    while n < MAX_TERMS and (n < few or added > SERIES_TOLERANCE * b):
        added = p * q
        total += added
        n += 1
        t_a *= a / n
        slope += t_a * t_b
        t_b *= b / n
        p -= t_a
        q -= t_b
    return total / b, slope


@vectorised
def _crossflow_rows(rows: int, lanes: Array, scale: Array, pull: Array, info: Array, chi2: Array) -> None:
    """Sums over each lane's samples; `lanes` holds NTU, flow ratio, effectiveness seen, and weight."""
    ntu, ratio, effectiveness, weight = lanes[0], lanes[1], lanes[2], lanes[3]
    for j in range(rows):
        for f in range(LANES):
            a = scale[f] * ntu[j, f]
            value, slope = _series(a, a * ratio[j, f])
            residual = effectiveness[j, f] - value
            pull[f] += weight[j, f] * slope * residual
            info[f] += weight[j, f] * slope * slope
            chi2[f] += weight[j, f] * residual * residual


@vectorised
def _long_crossflow_rows(rows: int, lanes: Array, scale: Array, pull: Array, info: Array, chi2: Array) -> None:
    """The same where the transfer units are so many that twelve terms do not do."""
    ntu, ratio, effectiveness, weight = lanes[0], lanes[1], lanes[2], lanes[3]
    for j in range(rows):
        for f in range(LANES):
            a = scale[f] * ntu[j, f]
            value, slope = _any_units(a, a * ratio[j, f])
            residual = effectiveness[j, f] - value
            pull[f] += weight[j, f] * slope * residual
            info[f] += weight[j, f] * slope * slope
            chi2[f] += weight[j, f] * residual * residual


@vectorised
def _lumped_rows(rows: int, lanes: Array, theta: Array, pull: Array, info: Array, chi2: Array) -> None:
    """Sums over each lane's samples; `lanes` holds heat-capacity rate, base, effectiveness seen, and weight."""
    rate, base, effectiveness, weight = lanes[0], lanes[1], lanes[2], lanes[3]
    for j in range(rows):
        for f in range(LANES):
            value = 1.0 / (base[j, f] + rate[j, f] * theta[f])
            slope = -rate[j, f] * value * value
            residual = effectiveness[j, f] - value
            pull[f] += weight[j, f] * slope * residual
            info[f] += weight[j, f] * slope * slope
            chi2[f] += weight[j, f] * residual * residual


@vectorised
def sums_of_step(
    crossflow: bool, rows: int, lanes: Array, theta: Array, sums: Array, scale: Array, peak: Array
) -> None:
    """Pull, information and sum of squares (3, lanes) at each lane's `theta`; `scale` is work space, `peak` its NTU."""
    sums[:] = 0.0
    if not crossflow:
        _lumped_rows(rows, lanes, theta, sums[0], sums[1], sums[2])
        return
    most = 0.0
    for f in range(LANES):
        scale[f] = np.exp(theta[f])
        most = max(most, scale[f] * scale[f] * peak[f])
    if most <= FEW_UNITS:
        _crossflow_rows(rows, lanes, scale, sums[0], sums[1], sums[2])
    else:
        _long_crossflow_rows(rows, lanes, scale, sums[0], sums[1], sums[2])
