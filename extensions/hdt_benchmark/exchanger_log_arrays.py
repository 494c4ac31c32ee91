"""The NumPy path of the log fit: all flights side by side, one time step after another."""

from __future__ import annotations

import numpy as np

from hdt_benchmark.exchanger_arrays import (
    CONVERGED,
    LONGEST_STEP,
    MAX_STEPS,
    MOST_STEPS,
    NOT_IDENTIFIABLE,
    Columns,
    Fit,
    Integers,
)
from hdt_core.estimation.problem import Array
from hdt_core.physics.lumped_exchanger import CP_COLD_J_KG_K, CP_HOT_J_KG_K

Four = tuple[Array, Array, Array, Array]
SETTLED = 1e-6
LEAST_H_W_K, MOST_H_W_K = 1.0, 1e6


def fits(columns: Columns, starts: Integers, pace: tuple[float, float]) -> Fit:
    """Fit every flight; short ones are padded without weight. `pace` is half the time step over each mass. [s/kg]"""
    n_flights, lengths = len(starts) - 1, np.diff(starts)
    row = np.arange(max(lengths.max(initial=1), 1))[:, None]
    at = np.minimum(starts[:-1] + np.minimum(row, np.maximum(lengths - 1, 0)), max(len(columns[0]) - 1, 0))
    hot_flow, ram_flow, hot_in, hot_out, cold_in, weight = (x[at] for x in columns)
    heavy = np.where(row < lengths, weight, 0.0)
    inputs = (hot_flow, ram_flow, hot_in, cold_in)
    n_used = np.count_nonzero(heavy, axis=0).astype(np.int64)
    theta, is_active = _start(inputs, hot_out, heavy), n_used > 0
    information, chi2, steps = np.zeros(n_flights), np.zeros(n_flights), np.zeros(n_flights, np.int64)
    for _ in range(MOST_STEPS):
        hot, hot_by = _march(np.exp(theta), inputs, pace)
        residual = hot_out - hot
        information = np.where(is_active, (heavy * hot_by**2).sum(0), information)
        chi2 = np.where(is_active, (heavy * residual**2).sum(0), chi2)
        step = np.where(is_active, (heavy * hot_by * residual).sum(0) / np.maximum(information, 1e-300), 0.0)
        theta = np.where(is_active, take_step(theta, step), theta)
        steps += is_active
        is_active &= np.abs(step) > SETTLED
        if not is_active.any():
            break
    code = np.where(n_used == 0, NOT_IDENTIFIABLE, np.where(is_active, MAX_STEPS, CONVERGED))
    return np.where(n_used > 0, theta, np.nan), information, chi2, n_used, steps, code


def _start(inputs: Four, hot_out: Array, heavy: Array) -> Array:
    whole = heavy.sum(0)
    means = [(heavy * x).sum(0) / np.maximum(whole, 1e-300) for x in (*inputs[:3], hot_out, inputs[3])]
    theta = mean_start(*(np.where(whole > 0.0, x, 1.0 + k) for k, x in enumerate(means)))
    hot, _, hot_by, _ = steady(np.exp(theta), *inputs)
    return take_step(theta, (heavy * hot_by * (hot_out - hot)).sum(0) / np.maximum((heavy * hot_by**2).sum(0), 1e-300))


def _march(h_w_k: Array, inputs: Four, pace: tuple[float, float]) -> tuple[Array, Array]:
    """Hot outlet and its derivative by ln H over time, (n_samples, n_flights) each."""
    hot_flow, ram_flow, hot_in, cold_in = inputs
    a, c, q, r = (
        pace[0] * hot_flow,
        pace[1] * ram_flow,
        pace[0] * h_w_k / CP_HOT_J_KG_K,
        pace[1] * h_w_k / CP_COLD_J_KG_K,
    )
    over = 2.0 / ((1.0 + a + q) * (1.0 + c + r) - q * r)
    hh, hc, ch, cc = (1.0 + c + r) * over, q * over, r * over, (1.0 + a + q) * over
    drive_h, drive_c = hh * a * hot_in + hc * c * cold_in, ch * a * hot_in + cc * c * cold_in
    pull_h, pull_c = 0.5 * hc * (1.0 + c), 0.5 * ch * (1.0 + a)
    hot, cold, hot_by, cold_by = steady(h_w_k, *(x[0] for x in inputs))
    outlet, by = np.empty_like(hh), np.empty_like(hh)
    for k in range(len(hh)):
        outlet[k], by[k] = hot, hot_by
        later_hot = (hh[k] - 1.0) * hot + hc[k] * cold + drive_h[k]
        later_cold = ch[k] * hot + (cc[k] - 1.0) * cold + drive_c[k]
        across = (hot - cold) + (later_hot - later_cold)
        hot_by, cold_by = (
            (hh[k] - 1.0) * hot_by + hc[k] * cold_by - pull_h[k] * across,
            ch[k] * hot_by + (cc[k] - 1.0) * cold_by + pull_c[k] * across,
        )
        hot, cold = later_hot, later_cold
    return outlet, by


def steady(h_w_k: Array, hot_flow: Array, ram_flow: Array, hot_in: Array, cold_in: Array) -> Four:
    """Return steady outlets and their derivatives by ln H."""
    hot_rate, cold_rate = hot_flow * CP_HOT_J_KG_K, ram_flow * CP_COLD_J_KG_K
    both = hot_rate * cold_rate
    share = 1.0 / (both + h_w_k * (hot_rate + cold_rate))
    span = h_w_k * (hot_in - cold_in) * share
    slope = span * both * share
    return hot_in - cold_rate * span, cold_in + hot_rate * span, -cold_rate * slope, hot_rate * slope


def mean_start(hot_flow: Array, ram_flow: Array, hot_in: Array, hot_out: Array, cold_in: Array) -> Array:
    """Return ln H of the mean sample in closed form."""
    inverse = (hot_out - cold_in) / ((hot_in - hot_out) * hot_flow * CP_HOT_J_KG_K) - 1.0 / (ram_flow * CP_COLD_J_KG_K)
    return -np.log(np.minimum(np.maximum(inverse, 1.0 / MOST_H_W_K), 1.0 / LEAST_H_W_K))


def take_step(theta: Array, step: Array) -> Array:
    """Apply a step, limited in length and to the bounds."""
    short = np.minimum(np.maximum(step, -LONGEST_STEP), LONGEST_STEP)
    return np.minimum(np.maximum(theta + short, np.log(LEAST_H_W_K)), np.log(MOST_H_W_K))
