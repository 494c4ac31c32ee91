"""Kernels of the log fit, a flight at a time."""

from __future__ import annotations

import numpy as np

from hdt_benchmark.exchanger_compiled import (
    CONVERGED,
    LONGEST_STEP,
    MAX_STEPS,
    MOST_STEPS,
    NOT_IDENTIFIABLE,
    Columns,
    Fit,
    Integers,
    vectorised,
)
from hdt_core.estimation.problem import Array
from hdt_core.physics.heat_exchanger import CP_COLD_J_KG_K, CP_HOT_J_KG_K

SETTLED = 1e-6
LEAST_H_W_K, MOST_H_W_K = 1.0, 1e6
BLOCK = 512  # steps whose coefficients stay in the nearest cache


@vectorised
def _steady(
    h_w_k: float, hot_flow: float, ram_flow: float, hot_in: float, cold_in: float
) -> tuple[float, float, float, float]:
    """Return steady outlets and their derivatives by ln H."""
    hot_rate, cold_rate = hot_flow * CP_HOT_J_KG_K, ram_flow * CP_COLD_J_KG_K
    both = hot_rate * cold_rate
    share = 1.0 / (both + h_w_k * (hot_rate + cold_rate))
    span = h_w_k * (hot_in - cold_in) * share
    slope = span * both * share
    return hot_in - cold_rate * span, cold_in + hot_rate * span, -cold_rate * slope, hot_rate * slope


@vectorised
def _mean_start(hot_flow: float, ram_flow: float, hot_in: float, hot_out: float, cold_in: float) -> float:
    """Return ln H of the mean sample in closed form."""
    inverse = (hot_out - cold_in) / ((hot_in - hot_out) * hot_flow * CP_HOT_J_KG_K) - 1.0 / (ram_flow * CP_COLD_J_KG_K)
    return float(-np.log(min(max(inverse, 1.0 / MOST_H_W_K), 1.0 / LEAST_H_W_K)))


@vectorised
def _take_step(theta: float, step: float) -> float:
    """Apply a step, limited in length and to the bounds."""
    short = min(max(step, -LONGEST_STEP), LONGEST_STEP)
    return float(min(max(theta + short, np.log(LEAST_H_W_K)), np.log(MOST_H_W_K)))


@vectorised
def is_whole(columns: Columns) -> bool:
    """Return whether no sample lacks a value."""
    hot_flow, ram_flow, hot_in, hot_out, cold_in, weight = columns
    bad = 0
    for k in range(len(hot_flow)):
        least = min(hot_flow[k], ram_flow[k], hot_in[k], hot_out[k], cold_in[k], weight[k])
        total = hot_flow[k] + ram_flow[k] + hot_in[k] + hot_out[k] + cold_in[k] + weight[k]
        bad += 0 if (least > 0.0) & (total < np.inf) else 1
    return bad == 0


@vectorised
def _start(flight: Columns) -> float:
    hot_flow, ram_flow, hot_in, hot_out, cold_in, weight = flight
    whole, a, b, c, d, e = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(hot_flow)):
        whole += weight[k]
        a += weight[k] * hot_flow[k]
        b += weight[k] * ram_flow[k]
        c += weight[k] * hot_in[k]
        d += weight[k] * hot_out[k]
        e += weight[k] * cold_in[k]
    theta = _mean_start(a / whole, b / whole, c / whole, d / whole, e / whole)
    h, pull, information = np.exp(theta), 0.0, 0.0
    for k in range(len(hot_flow)):  # `_steady` written out, for the vector registers
        hot_rate, cold_rate = hot_flow[k] * CP_HOT_J_KG_K, ram_flow[k] * CP_COLD_J_KG_K
        share = 1.0 / (hot_rate * cold_rate + h * (hot_rate + cold_rate))
        span = h * (hot_in[k] - cold_in[k]) * share * cold_rate
        hot_by = -span * hot_rate * cold_rate * share
        pull += weight[k] * hot_by * (hot_out[k] - hot_in[k] + span)
        information += weight[k] * hot_by * hot_by
    return float(_take_step(theta, pull / max(information, 1e-300)))


@vectorised
def _coefficient_rows(h_w_k: float, block: Columns, pace: tuple[float, float], rows: Array) -> None:
    """Coefficients of a block of steps. One short loop a row: with more arrays in one, it is not vectorised."""
    hot_flow, ram_flow, hot_in, _, cold_in, _ = block
    hh, cc, over, drive_h, drive_c = rows[0], rows[1], rows[2], rows[3], rows[4]
    to_a, to_c = pace
    q, r = to_a * h_w_k / CP_HOT_J_KG_K, to_c * h_w_k / CP_COLD_J_KG_K
    n = len(hot_flow)
    for k in range(n):
        over[k] = 2.0 / ((1.0 + to_a * hot_flow[k] + q) * (1.0 + to_c * ram_flow[k] + r) - q * r)
    for k in range(n):
        hh[k] = (1.0 + to_c * ram_flow[k] + r) * over[k]
    for k in range(n):
        cc[k] = (1.0 + to_a * hot_flow[k] + q) * over[k]
    for k in range(n):
        drive_h[k] = hh[k] * (to_a * hot_flow[k] * hot_in[k]) + q * over[k] * (to_c * ram_flow[k] * cold_in[k])
    for k in range(n):
        drive_c[k] = r * over[k] * (to_a * hot_flow[k] * hot_in[k]) + cc[k] * (to_c * ram_flow[k] * cold_in[k])


@vectorised
def _pass(theta: float, flight: Columns, pace: tuple[float, float]) -> tuple[float, float, float]:
    """One flight's sums of pull, information and squared residuals at this ln H."""
    hot_flow, ram_flow, hot_in, hot_out, cold_in, weight = flight
    h = np.exp(theta)
    hot, cold, hot_by, cold_by = _steady(h, hot_flow[0], ram_flow[0], hot_in[0], cold_in[0])
    to_a, to_c = pace
    q, r = to_a * h / CP_HOT_J_KG_K, to_c * h / CP_COLD_J_KG_K
    rows, outlet, by = np.empty((5, BLOCK)), np.empty(BLOCK), np.empty(BLOCK)
    pull, information, chi2 = 0.0, 0.0, 0.0
    for first in range(0, len(hot_flow), BLOCK):
        at = slice(first, first + BLOCK)
        block = (hot_flow[at], ram_flow[at], hot_in[at], hot_out[at], cold_in[at], weight[at])
        _coefficient_rows(h, block, pace, rows)
        hot_flows, ram_flows, _, measured_outlet, _, heavy = block
        for k in range(len(hot_flows)):
            outlet[k], by[k] = hot, hot_by
            hh, cc, hc, ch = rows[0, k] - 1.0, rows[1, k] - 1.0, q * rows[2, k], r * rows[2, k]
            later_hot, later_cold = hh * hot + (hc * cold + rows[3, k]), ch * hot + (cc * cold + rows[4, k])
            half_across = 0.5 * ((hot - cold) + (later_hot - later_cold))
            pull_h, pull_c = hc * (1.0 + to_c * ram_flows[k]), ch * (1.0 + to_a * hot_flows[k])
            hot_by, cold_by = (
                hh * hot_by + (hc * cold_by - pull_h * half_across),
                ch * hot_by + (cc * cold_by + pull_c * half_across),
            )
            hot, cold = later_hot, later_cold
        for k in range(len(hot_flows)):
            residual = measured_outlet[k] - outlet[k]
            pull += heavy[k] * by[k] * residual
            information += heavy[k] * by[k] * by[k]
            chi2 += heavy[k] * residual * residual
    return pull, information, chi2


@vectorised
def fits(columns: Columns, starts: Integers, pace: tuple[float, float]) -> Fit:
    """Fit every flight. `pace` is half the time step over each mass. [s/kg]"""
    hot_flow, ram_flow, hot_in, hot_out, cold_in, weight = columns
    n_flights = len(starts) - 1
    mean, information, chi2 = np.full(n_flights, np.nan), np.zeros(n_flights), np.zeros(n_flights)
    n_used, steps = np.zeros(n_flights, np.int64), np.zeros(n_flights, np.int64)
    code = np.full(n_flights, NOT_IDENTIFIABLE)
    for f in range(n_flights):
        own = slice(starts[f], starts[f + 1])
        flight = (hot_flow[own], ram_flow[own], hot_in[own], hot_out[own], cold_in[own], weight[own])
        n_used[f] = np.count_nonzero(weight[own])
        if n_used[f] == 0:
            continue
        theta = _start(flight)
        code[f] = MAX_STEPS
        for _ in range(MOST_STEPS):
            pull, information[f], chi2[f] = _pass(theta, flight, pace)
            steps[f] += 1
            step = pull / max(information[f], 1e-300)
            theta = _take_step(theta, step)
            if abs(step) <= SETTLED:
                code[f] = CONVERGED
                break
        mean[f] = theta
    return mean, information, chi2, n_used, steps, code
