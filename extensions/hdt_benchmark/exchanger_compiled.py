"""Kernels of the per-flight exchanger fits: sixteen flights side by side, for the vector registers."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from hdt_benchmark.exchanger_rows import FEW_UNITS, LANES, LARGER_UNITS, sums_of_step, vectorised
from hdt_core.estimation.compiled import linked
from hdt_core.estimation.problem import Array
from hdt_core.physics.air import mean_specific_heat_j_kg_k, warmed_k
from hdt_core.physics.lumped_exchanger import CP_COLD_J_KG_K, CP_HOT_J_KG_K

CONVERGED, AT_BOUND, MAX_STEPS, NOT_IDENTIFIABLE = 0, 1, 2, 3
LEAST_SPAN_K = 1.0  # between the inlets; below it a sample says nothing about the exchanger
MOST_STEPS = 25
START_STEPS = 4
SETTLED = 1e-5  # what is left after such a step is about a hundredth of it
LONGEST_STEP = 1.0
BOUND = 4.0  # of ln UA over the clean UA
KILO = 1000.0  # 1/H is fitted per kW/K, so that steps and tolerance are of order one

Integers = npt.NDArray[np.int64]
Columns = tuple[Array, Array, Array, Array, Array, Array]
"""Hot flow, ram flow, hot in, hot out, cold in, weight: (n_samples,) each."""
Fit = tuple[Array, Array, Array, Integers, Integers, Integers]

_mean_heat = vectorised(mean_specific_heat_j_kg_k)
_warmed = vectorised(linked(warmed_k, mean_specific_heat_j_kg_k=_mean_heat))


def conductance_scale(samples: Columns, clean_ua_w_k: Array, starts: Integers) -> Fit:
    """See `exchanger.fit_conductance_scale`."""
    mean, information, chi2, n_used, steps, code = _fits(True, samples, clean_ua_w_k, starts)
    at_bound = (np.abs(mean) >= BOUND) & (code != NOT_IDENTIFIABLE)
    return mean, information, chi2, n_used, steps, np.where(at_bound, AT_BOUND, code)


def lumped_resistance(samples: Columns, starts: Integers) -> Fit:
    """See `exchanger.fit_lumped_resistance`."""
    mean, information, chi2, n_used, steps, code = _fits(False, samples, samples[0], starts)
    at_bound = (mean <= 0.0) & (code != NOT_IDENTIFIABLE)
    return mean / KILO, information * KILO**2, chi2, n_used, steps, np.where(at_bound, AT_BOUND, code)


@vectorised
def _crossflow_terms(
    hot_flow: Array, ram_flow: Array, hot_in: Array, hot_out: Array, cold_in: Array, clean: Array, flat: Array
) -> None:
    """NTU and ratio of capacity rates of each sample, by `physics.heat_exchanger.capacity_rates`.

    One short loop a row: with more arrays in one it is not vectorised. The last two rows are work space.
    """
    ntu, ratio, rate, heat = flat[0], flat[1], flat[2], flat[3]
    for i in range(len(hot_flow)):
        rate[i] = hot_flow[i] * _mean_heat(hot_in[i], hot_out[i])
    for i in range(len(hot_flow)):
        heat[i] = rate[i] * (hot_in[i] - hot_out[i]) / ram_flow[i]
    for i in range(len(hot_flow)):
        ratio[i] = _mean_heat(cold_in[i], _warmed(cold_in[i], heat[i]))
    for i in range(len(hot_flow)):
        ratio[i] = rate[i] / (ram_flow[i] * ratio[i])
    for i in range(len(hot_flow)):
        ntu[i] = clean[i] / rate[i]


@vectorised
def _lumped_terms(hot_flow: Array, ram_flow: Array, flat: Array) -> None:
    """Heat-capacity rate and base of each sample."""
    rate, base = flat[0], flat[1]
    for i in range(len(hot_flow)):
        rate[i] = hot_flow[i] * (CP_HOT_J_KG_K / KILO)
    for i in range(len(hot_flow)):
        base[i] = 1.0 + hot_flow[i] * CP_HOT_J_KG_K / (ram_flow[i] * CP_COLD_J_KG_K)


@vectorised
def _measured_terms(hot_in: Array, hot_out: Array, cold_in: Array, weight: Array, flat: Array) -> None:
    """Compute measured effectiveness and its weight; 0 where a value is missing or the sample uninformative."""
    first, second, effectiveness, heavy = flat[0], flat[1], flat[2], flat[3]
    for i in range(len(hot_in)):
        effectiveness[i] = (hot_in[i] - hot_out[i]) / (hot_in[i] - cold_in[i])
    for i in range(len(hot_in)):
        span = hot_in[i] - cold_in[i]
        finite = (first[i] < np.inf) & (second[i] < np.inf) & (abs(effectiveness[i]) < np.inf) & (weight[i] < np.inf)
        is_informative = (first[i] > 0.0) & (second[i] > 0.0) & (span >= LEAST_SPAN_K) & (weight[i] > 0.0)
        heavy[i] = weight[i] * span * span if finite & is_informative else 0.0


@vectorised
def _lay_down(flat: Array, begin: int, length: int, rows: int, lane: int, lanes: Array) -> tuple[int, float]:
    """Copy one flight into a lane; unusable samples and padding get weight 0.

    Returns how many count, and what `sums_of_step` holds against `FEW_UNITS`.
    """
    n_used, peak = 0, 0.0
    for j in range(length):
        i = begin + j
        if flat[3, i] > 0.0:
            lanes[0, j, lane], lanes[1, j, lane] = flat[0, i], flat[1, i]
            lanes[2, j, lane], lanes[3, j, lane] = flat[2, i], flat[3, i]
            larger = max(1.0, flat[1, i] * flat[1, i]) * (FEW_UNITS / LARGER_UNITS**2)
            peak = max(peak, flat[0, i] * flat[0, i] * max(flat[1, i], larger))
            n_used += 1
        else:
            lanes[0, j, lane], lanes[1, j, lane], lanes[2, j, lane], lanes[3, j, lane] = 1.0, 1.0, 0.0, 0.0
    for j in range(length, rows):
        lanes[0, j, lane], lanes[1, j, lane], lanes[2, j, lane], lanes[3, j, lane] = 1.0, 1.0, 0.0, 0.0
    return n_used, peak


@vectorised
def _middle(rows: int, lanes: Array, middle: Array) -> None:
    """Compute each lane's weighted mean sample, used for the start."""
    first, second, effectiveness, whole = middle[0, 0], middle[1, 0], middle[2, 0], middle[3, 0]
    middle[:] = 0.0
    for j in range(rows):
        for f in range(LANES):
            whole[f] += lanes[3, j, f]
            first[f] += lanes[3, j, f] * lanes[0, j, f]
            second[f] += lanes[3, j, f] * lanes[1, j, f]
            effectiveness[f] += lanes[3, j, f] * lanes[2, j, f]
    for f in range(LANES):
        over = 1.0 / whole[f] if whole[f] > 0.0 else 0.0
        empty = 0.0 if whole[f] > 0.0 else 1.0
        first[f], second[f], effectiveness[f] = (
            first[f] * over + empty,
            second[f] * over + empty,
            effectiveness[f] * over + empty,
        )
        whole[f] = 1.0


@vectorised
def _take_step(theta: float, step: float) -> float:
    return min(max(theta + min(max(step, -LONGEST_STEP), LONGEST_STEP), -BOUND), BOUND)


@vectorised
def _fits(crossflow: bool, samples: Columns, clean: Array, starts: Integers) -> Fit:  # noqa: PLR0912
    hot_flow, ram_flow, hot_in, hot_out, cold_in, weight = samples
    n_flights = len(starts) - 1
    longest, widest = 1, 1
    for f in range(n_flights):
        longest = max(longest, starts[f + 1] - starts[f])
        widest = max(widest, starts[min(f + LANES, n_flights)] - starts[f])
    lanes, middle, flat = np.empty((4, longest, LANES)), np.empty((4, 1, LANES)), np.empty((4, widest))
    theta, scale, peak, sums = np.empty(LANES), np.empty(LANES), np.empty(LANES), np.empty((3, LANES))
    is_active = np.empty(LANES, np.bool_)
    mean, information, chi2 = np.full(n_flights, np.nan), np.zeros(n_flights), np.zeros(n_flights)
    n_used, steps = np.zeros(n_flights, np.int64), np.zeros(n_flights, np.int64)
    code = np.full(n_flights, NOT_IDENTIFIABLE)
    for first in range(0, n_flights, LANES):
        together = min(LANES, n_flights - first)
        a, z = starts[first], starts[first + together]
        if crossflow:
            _crossflow_terms(hot_flow[a:z], ram_flow[a:z], hot_in[a:z], hot_out[a:z], cold_in[a:z], clean[a:z], flat)
        else:
            _lumped_terms(hot_flow[a:z], ram_flow[a:z], flat)
        _measured_terms(hot_in[a:z], hot_out[a:z], cold_in[a:z], weight[a:z], flat)
        rows = 1
        for f in range(together):
            rows = max(rows, starts[first + f + 1] - starts[first + f])
        for f in range(LANES):
            at = first + min(f, together - 1)
            length = starts[at + 1] - starts[at] if f < together else 0
            n_samples, peak[f] = _lay_down(flat, starts[at] - a, length, rows, f, lanes)
            theta[f], is_active[f] = 0.0, n_samples > 0
            if f < together:
                n_used[first + f] = n_samples
        _middle(rows, lanes, middle)
        for _ in range(START_STEPS):
            sums_of_step(crossflow, 1, middle, theta, sums, scale, peak)
            for f in range(LANES):
                theta[f] = _take_step(theta[f], sums[0, f] / sums[1, f])
        for _ in range(MOST_STEPS):
            sums_of_step(crossflow, rows, lanes, theta, sums, scale, peak)
            any_active = False
            for f in range(together):
                if is_active[f]:
                    step = sums[0, f] / max(sums[1, f], 1e-300)
                    theta[f] = _take_step(theta[f], step)
                    information[first + f], chi2[first + f] = sums[1, f], sums[2, f]
                    steps[first + f] += 1
                    is_active[f] = abs(step) > SETTLED
                    any_active = any_active or is_active[f]
            if not any_active:
                break
        for f in range(together):
            if n_used[first + f] > 0:
                mean[first + f] = theta[f]
                code[first + f] = MAX_STEPS if is_active[f] else CONVERGED
    return mean, information, chi2, n_used, steps, code
