"""Kernels of the per-flight exchanger fit: sixteen samples of a flight side by side, for the vector registers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt

from hdt_core.estimation.compiled import COMPILED, linked
from hdt_core.estimation.problem import Array
from hdt_core.physics.air import mean_specific_heat_j_kg_k, warmed_k
from hdt_core.physics.effectiveness import MAX_TERMS, SERIES_TOLERANCE, SERIES_UNITS, contour_sums

CONVERGED, AT_BOUND, MAX_STEPS, NOT_IDENTIFIABLE = 0, 1, 2, 3
LEAST_SPAN_K = 1.0  # between the inlets; below it a sample says nothing about the exchanger
MOST_STEPS = 25
SETTLED = 1e-5  # what is left after such a step is about a hundredth of it
LONGEST_STEP = 1.0
BOUND = 4.0  # of ln UA over the clean UA
LANES = 16  # samples at once: two registers of eight doubles, or four of four
BLOCK = 16  # flights whose terms stay in the nearest cache
TERMS, FEW_UNITS = 12, 8.0  # terms of the series, good to 3e-11 while the product of both sides' NTU is this or less
LARGER_UNITS = 32.0  # and the larger of the two this
FREELY = {"reassoc", "contract", "arcp", "nsz"}

Integers = npt.NDArray[np.int64]
Columns = tuple[Array, Array, Array, Array, Array, Array]
"""Hot flow, ram flow, hot in, hot out, cold in, weight: (n_samples,) each."""
Fit = tuple[Array, Array, Array, Integers, Integers, Integers]
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


_mean_heat = vectorised(mean_specific_heat_j_kg_k)
_warmed = vectorised(linked(warmed_k, mean_specific_heat_j_kg_k=_mean_heat))
_contour_sums: Any = vectorised(contour_sums)  # the same equation, one number at a time


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
def _terms(
    hot_flow: Array, ram_flow: Array, hot_in: Array, hot_out: Array, cold_in: Array, weight: Array, clean: Array,
    flat: Array,
) -> None:  # fmt: skip
    """NTU, ratio of capacity rates by `physics.heat_exchanger.capacity_rates`, measured effectiveness and its weight.

    The weight is 0 where a value is missing or the sample uninformative. One short loop a row: with more arrays in one
    it is not vectorised.
    """
    ntu, ratio, effectiveness, heavy = flat[0], flat[1], flat[2], flat[3]  # the last two are work space at first
    n = len(hot_flow)
    for i in range(n):
        effectiveness[i] = hot_flow[i] * _mean_heat(hot_in[i], hot_out[i])
    for i in range(n):
        heavy[i] = effectiveness[i] * (hot_in[i] - hot_out[i]) / ram_flow[i]
    for i in range(n):
        ratio[i] = _mean_heat(cold_in[i], _warmed(cold_in[i], heavy[i]))
    for i in range(n):
        ratio[i] = effectiveness[i] / (ram_flow[i] * ratio[i])
    for i in range(n):
        ntu[i] = clean[i] / effectiveness[i]
    for i in range(n):
        effectiveness[i] = (hot_in[i] - hot_out[i]) / (hot_in[i] - cold_in[i])
    for i in range(n):
        span = hot_in[i] - cold_in[i]
        finite = (ntu[i] < np.inf) & (ratio[i] < np.inf) & (abs(effectiveness[i]) < np.inf) & (weight[i] < np.inf)
        is_informative = (ntu[i] > 0.0) & (ratio[i] > 0.0) & (span >= LEAST_SPAN_K) & (weight[i] > 0.0)
        heavy[i] = weight[i] * span * span if finite & is_informative else 0.0


@vectorised
def _lay_down(flat: Array, begin: int, end: int, lanes: Array) -> tuple[int, float]:
    """Copy the samples of a flight that count, and fill the last row of lanes with some of weight 0.

    Returns how many count, and what `_sums` holds against `FEW_UNITS`.
    """
    n, peak = 0, 0.0
    for i in range(begin, end):
        if flat[3, i] > 0.0:
            lanes[0, n], lanes[1, n], lanes[2, n], lanes[3, n] = flat[0, i], flat[1, i], flat[2, i], flat[3, i]
            larger = max(1.0, flat[1, i] * flat[1, i]) * (FEW_UNITS / LARGER_UNITS**2)
            peak = max(peak, flat[0, i] * flat[0, i] * max(flat[1, i], larger))
            n += 1
    for j in range(n, -(-n // LANES) * LANES):
        lanes[0, j], lanes[1, j], lanes[2, j], lanes[3, j] = 1.0, 1.0, 0.0, 0.0
    return n, peak


@vectorised
def _start(n: int, lanes: Array) -> float:
    """Return ln UA over the clean UA of the mean sample: counterflow in closed form, and a Newton step from there."""
    ntu, ratio, effectiveness, whole = 0.0, 0.0, 0.0, 0.0
    for j in range(n):
        whole += lanes[3, j]
        ntu += lanes[3, j] * lanes[0, j]
        ratio += lanes[3, j] * lanes[1, j]
        effectiveness += lanes[3, j] * lanes[2, j]
    ntu, ratio = ntu / whole, ratio / whole
    eps = min(max(effectiveness / whole, 1e-3), 0.999 / max(ratio, 1.0))
    apart = ratio - 1.0 if abs(ratio - 1.0) > 1e-6 else 1e-6
    theta = np.log(np.log((1.0 - eps) / (1.0 - eps * (1.0 + apart))) / apart / ntu)
    a = np.exp(theta) * ntu
    if a * a * ratio < FEW_UNITS:
        value, slope = _series(a, a * ratio)
        theta += (effectiveness / whole - value) / slope
    return float(theta)


@vectorised
def _sums(n: int, lanes: Array, scale: float, peak: float) -> tuple[float, float, float]:
    """Pull, information and sum of squares over a flight's samples, at UA `scale` times the clean UA."""
    ntu, ratio, effectiveness, weight = lanes[0], lanes[1], lanes[2], lanes[3]
    pull, info, chi2 = 0.0, 0.0, 0.0
    if scale * scale * peak > FEW_UNITS:
        for k in range(n):
            value, slope = _any_units(scale * ntu[k], scale * ntu[k] * ratio[k])
            residual = effectiveness[k] - value
            pull += weight[k] * slope * residual
            info += weight[k] * slope * slope
            chi2 += weight[k] * residual * residual
        return pull, info, chi2
    for first in range(0, n, LANES):
        for k in range(first, first + LANES):
            a = scale * ntu[k]
            value, slope = _series(a, a * ratio[k])
            residual = effectiveness[k] - value
            pull += weight[k] * slope * residual
            info += weight[k] * slope * slope
            chi2 += weight[k] * residual * residual
    return pull, info, chi2


@vectorised
def conductance_scale(samples: Columns, clean: Array, starts: Integers) -> Fit:
    """See `exchanger.fit_conductance_scale`."""
    hot_flow, ram_flow, hot_in, hot_out, cold_in, weight = samples
    n_flights, longest, widest = len(starts) - 1, 1, 1
    for f in range(n_flights):
        longest = max(longest, starts[f + 1] - starts[f])
        widest = max(widest, starts[min(f + BLOCK, n_flights)] - starts[f])
    flat, lanes = np.empty((4, widest)), np.empty((4, longest + LANES))
    mean, information, chi2 = np.full(n_flights, np.nan), np.zeros(n_flights), np.zeros(n_flights)
    n_used, steps = np.zeros(n_flights, np.int64), np.zeros(n_flights, np.int64)
    code = np.full(n_flights, NOT_IDENTIFIABLE)
    for f in range(n_flights):
        if f % BLOCK == 0:
            a, z = starts[f], starts[min(f + BLOCK, n_flights)]
            _terms(hot_flow[a:z], ram_flow[a:z], hot_in[a:z], hot_out[a:z], cold_in[a:z], weight[a:z], clean[a:z], flat)
        n_used[f], peak = _lay_down(flat, starts[f] - a, starts[f + 1] - a, lanes)
        if n_used[f] == 0:
            continue
        theta, code[f] = _start(n_used[f], lanes), MAX_STEPS
        for _ in range(MOST_STEPS):
            pull, information[f], chi2[f] = _sums(n_used[f], lanes, np.exp(theta), peak)
            step = pull / max(information[f], 1e-300)
            theta = min(max(theta + min(max(step, -LONGEST_STEP), LONGEST_STEP), -BOUND), BOUND)
            steps[f] += 1
            if abs(step) <= SETTLED:
                code[f] = CONVERGED
                break
        mean[f] = theta
        if abs(theta) >= BOUND:
            code[f] = AT_BOUND
    return mean, information, chi2, n_used, steps, code
