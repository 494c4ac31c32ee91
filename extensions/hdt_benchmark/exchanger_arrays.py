"""The NumPy path of the per-flight exchanger fits: every step over all samples of all flights at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from hdt_core.estimation.problem import Array
from hdt_core.physics.effectiveness import crossflow_effectiveness_and_slope
from hdt_core.physics.heat_exchanger import capacity_rates
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
Curve = Callable[[Array, Array, Array], tuple[Array, Array]]


def conductance_scale(samples: Columns, clean_ua_w_k: Array, starts: Integers) -> Fit:
    """See `exchanger.fit_conductance_scale`."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        rate_w_k, ratio = capacity_rates(*samples[:5])
        ntu = clean_ua_w_k / rate_w_k
    return bounded_scale(_fit(_crossflow, samples, ntu, ratio, starts))


def lumped_resistance(samples: Columns, starts: Integers) -> Fit:
    """See `exchanger.fit_lumped_resistance`."""
    hot_flow, ram_flow, *_ = samples
    with np.errstate(divide="ignore", invalid="ignore"):
        rate = hot_flow * CP_HOT_J_KG_K
        base = 1.0 + rate / (ram_flow * CP_COLD_J_KG_K)
    return bounded_resistance(_fit(_lumped, samples, rate / KILO, base, starts))


def bounded_scale(fit: Fit) -> Fit:
    """Mark the flights that no conductance explains."""
    mean, information, chi2, n_used, steps, code = fit
    at_bound = (np.abs(mean) >= BOUND) & (code != NOT_IDENTIFIABLE)
    return mean, information, chi2, n_used, steps, np.where(at_bound, AT_BOUND, code)


def bounded_resistance(fit: Fit) -> Fit:
    """Mark the flights that no H above 0 explains; back to K/W."""
    mean, information, chi2, n_used, steps, code = fit
    at_bound = (mean <= 0.0) & (code != NOT_IDENTIFIABLE)
    return mean / KILO, information * KILO**2, chi2, n_used, steps, np.where(at_bound, AT_BOUND, code)


def _crossflow(theta: Array, ntu: Array, ratio: Array) -> tuple[Array, Array]:
    this = np.exp(theta) * ntu
    return crossflow_effectiveness_and_slope(this, this * ratio)


def _lumped(theta: Array, rate: Array, base: Array) -> tuple[Array, Array]:
    effectiveness = 1.0 / (base + rate * theta)
    return effectiveness, -rate * effectiveness**2


def _fit(curve: Curve, samples: Columns, first: Array, second: Array, starts: Integers) -> Fit:
    """Fit by Gauss-Newton on the effectiveness; its residual times the inlet span is that of the temperature."""
    _, _, hot_in, hot_out, cold_in, weight = samples
    n_flights = len(starts) - 1
    flight = np.repeat(np.arange(n_flights), np.diff(starts))
    rows = slice(starts[0], starts[-1])
    span = hot_in - cold_in
    with np.errstate(divide="ignore", invalid="ignore"):
        effectiveness = (hot_in - hot_out) / span
    with np.errstate(invalid="ignore"):
        usable = np.isfinite(first) & np.isfinite(second) & np.isfinite(effectiveness) & np.isfinite(weight)
        usable &= (first > 0.0) & (second > 0.0) & (span >= LEAST_SPAN_K) & (weight > 0.0)
    heavy, first, second, effectiveness = (
        np.where(usable, x, other)[rows]
        for x, other in ((weight * span**2, 0.0), (first, 1.0), (second, 1.0), (effectiveness, 0.0))
    )

    def total(x: Array) -> Array:
        return np.bincount(flight, weights=x, minlength=n_flights).astype(np.float64)

    n_used = np.bincount(flight, weights=usable[rows], minlength=n_flights).astype(np.int64)
    whole = np.maximum(total(heavy), 1e-300)
    middle = [np.where(n_used > 0, total(heavy * x) / whole, 1.0) for x in (first, second, effectiveness)]
    theta = np.zeros(n_flights)
    for _ in range(START_STEPS):
        value, slope = curve(theta, middle[0], middle[1])
        theta = _take_step(theta, (middle[2] - value) / slope)
    information, chi2 = np.zeros(n_flights), np.zeros(n_flights)
    steps, is_active = np.zeros(n_flights, np.int64), n_used > 0
    for _ in range(MOST_STEPS):
        value, slope = curve(theta[flight], first, second)
        residual = effectiveness - value
        information = np.where(is_active, total(heavy * slope**2), information)
        chi2 = np.where(is_active, total(heavy * residual**2), chi2)
        step = np.where(is_active, total(heavy * slope * residual) / np.maximum(information, 1e-300), 0.0)
        theta = np.where(is_active, _take_step(theta, step), theta)
        steps += is_active
        is_active &= np.abs(step) > SETTLED
        if not is_active.any():
            break
    code = np.where(n_used == 0, NOT_IDENTIFIABLE, np.where(is_active, MAX_STEPS, CONVERGED))
    return np.where(n_used > 0, theta, np.nan), information, chi2, n_used, steps, code


def _take_step(theta: Array, step: Array) -> Array:
    return np.clip(theta + np.clip(step, -LONGEST_STEP, LONGEST_STEP), -BOUND, BOUND)
