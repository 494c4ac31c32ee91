"""Fit a fleet robustly: design shared by all, sensor biases by pack, health free flight by flight.

Gauss-Newton on the logarithm of measured over expected conductance. Health is a random walk of each pack with a wide
step, estimated together with the design, so wear in the data isn't taken as normal. The controller opens the door when
the core cools less, so the door depends on health and a plain fit is biased. Flights are therefore compared by
instrumental variables, the weather and the flight level, which move the door and don't depend on it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solveh_banded

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import Array, Points
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s

HEALTH_STEP = 0.01
"""Random walk of health a flight, wide on purpose: see the module's docstring."""
FLIGHT_SD = 0.02
"""Scatter of a flight's conductance about its health: weather, trim, the map's own error."""
LAW_SD = 0.01
DESIGN_EFFECT, DESIGN_EFFECT_BLIND = 10.0, 40.0
"""Errors of neighbouring points are not independent (season, route, model error): each counts as 1/10. Where no ram
outlet is measured the scale of the ram flow depends on small effects alone, and each counts as 1/40."""
RAM_BALANCE_SD, RAM_DESIGN_EFFECT = 0.015, 10.0
MIN_RAM_POINTS = 20
LN_FLOW_RATIO, LN_FLOW_RATIO_SD = float(np.log(1.5)), 0.15
"""Prior of ram over pack flow in cruise: more costs drag, less can't cool. Matters where no ram outlet is measured."""
MAX_AVERAGED = 6.0
FIRST_LEVEL_SD = 0.3
ITERATIONS, MIN_ITERATIONS, TOLERANCE, MAX_STEP = 15, 6, 1e-4, 0.5
CAUCHY_SD = 3.0
JUMP_SD, JUMP_FREEDOM, JUMPS_FROM_ITERATION = 4.0, 1e3, 3
N_DESIGN, N_BIAS = len(hx.NAMES), len(hx.BIASES)

Residual = Callable[[Mapping[str, Array], Array, Array], Array]


@dataclass(frozen=True, slots=True)
class ExchangerFit:
    """Design `mean` (p,) and `cov` (p, p), sensor `bias` (packs, 6); `has_ram_outlet`: a ram outlet fixed the scale."""

    mean: Array
    cov: Array
    bias: Array
    converged: bool
    has_ram_outlet: bool


class _Linear(NamedTuple):
    """Columns (n, p + 6 + 1): derivatives by design and bias, and the residual; weight (n,), 0 where unusable."""

    columns: Array
    weight: Array


class _Pack(NamedTuple):
    """One pack's points: rows, their flight counted from 0, steps between flights, prior of its sensors."""

    rows: Array
    flight_of_row: Array
    gaps: Array
    bias_mean: Array
    bias_sd: Array


class _Elimination(NamedTuple):
    """Terms that give a pack's bias and health back after a step of the design."""

    health_response: Array  # (flights, p + 6 + 1)
    factor: tuple[Array, bool]
    coupling: Array
    right: Array


def fit_exchanger(points: Points, bias_mean: Array, bias_sd: Array) -> ExchangerFit:
    """Fit design and biases to cruise points.

    Parameters
    ----------
    points : Points
        Level medians, sorted by pack and flight.
    bias_mean, bias_sd : array
        Prior of each pack's sensors, (packs, 6); a pack without points keeps it.

    Notes
    -----
    Eliminating the random walk of a pack costs a tridiagonal solve, eliminating its biases a 6 x 6 one: the work is
    linear in flights. Weights are Cauchy's, steps of health beyond 4 sd are freed (a replacement, a clog).
    """
    has_ram_outlet = bool(np.isfinite(points.signals["ram_out_k"]).sum() >= MIN_RAM_POINTS)
    effect = DESIGN_EFFECT if has_ram_outlet else DESIGN_EFFECT_BLIND
    packs = {k: _pack(points, k, bias_mean[k], bias_sd[k]) for k in range(len(bias_mean)) if (points.pack == k).any()}
    design, bias = hx.MEAN.copy(), bias_mean.copy()
    health, cov, converged = np.full(len(points), np.nan), np.diag(hx.SD**2), not packs
    instruments = instruments_of(points.signals)
    for iteration in range(ITERATIONS if packs else 0):
        hot = _hot(points, design, bias, health, effect)
        ram = _ram(points, design, bias, robust=iteration > 0) if has_ram_outlet else None
        derivatives = _first_stage(packs, hot, instruments, effect)
        normal, right = _prior_terms(points, design)
        eliminations = {}
        for k, pack in packs.items():
            gram, response = _gram(pack, hot, ram, derivatives, effect)
            eliminations[k] = _eliminate(gram, response, pack, bias[k])
            coupling, factor = eliminations[k].coupling, eliminations[k].factor
            normal += gram[:N_DESIGN, :N_DESIGN] - coupling @ cho_solve(factor, coupling.T)
            right += -gram[:N_DESIGN, -1] - coupling @ cho_solve(factor, eliminations[k].right)
        cov = np.linalg.inv(normal)
        new_design = np.clip(design + np.clip(cov @ right, -MAX_STEP, MAX_STEP), hx.LOW, hx.HIGH)
        step, design = new_design - design, new_design
        for k, (response, factor, coupling, bias_right) in eliminations.items():
            change = cho_solve(factor, bias_right - coupling.T @ step)
            bias[k] += change
            level = response @ np.r_[step, change, 1.0]
            health[packs[k].rows] = level[packs[k].flight_of_row]
            if iteration >= JUMPS_FROM_ITERATION:
                packs[k] = packs[k]._replace(gaps=_widen_jumps(points, packs[k], level))
        converged = bool(np.abs(step).max() < TOLERANCE)
        if converged and iteration >= MIN_ITERATIONS:
            break
    return ExchangerFit(design, cov, bias, converged, has_ram_outlet)


def instruments_of(signals: Mapping[str, Array]) -> Array:
    """Compute instrumental variables of the door: weather, level, speed, and the pack's demand. (n, 8)"""
    base = np.stack(
        [
            np.log(signals["tat_k"] / 255.0),
            np.log(signals["total_pressure_pa"] / 3e4),
            np.log(signals["hx_in_k"] / 400.0),
            np.log(signals["mach"] / 0.83),
            np.log(signals["pack_flow_kg_s"] / 0.8),
        ],
        axis=1,
    )
    return np.asarray(np.nan_to_num(np.c_[base, base[:, :2] ** 2, base[:, 0] * base[:, 1]]))


def _pack(points: Points, k: int, bias_mean: Array, bias_sd: Array) -> _Pack:
    rows = np.flatnonzero(points.pack == k)
    flights, flight_of_row = np.unique(points.flight[rows], return_inverse=True)
    return _Pack(rows, flight_of_row, np.diff(flights).astype(float), bias_mean, bias_sd)


def _widen_jumps(points: Points, pack: _Pack, level: Array) -> Array:
    """Widen steps between flights where health jumps."""
    gaps = np.diff(np.unique(points.flight[pack.rows])).astype(float)
    return np.asarray(gaps * (1.0 + JUMP_FREEDOM * (np.abs(np.diff(level)) > JUMP_SD * HEALTH_STEP)))


def _linearise(function: Residual, points: Points, design: Array, bias: Array) -> Array:
    """Compute columns of `_Linear` by forward differences."""
    point_bias = bias[points.pack].T
    residual = function(points.signals, design, point_bias)
    by_design = hx.design_gradient(points.signals, design, point_bias, residual, function)
    by_bias = []
    for unit, sd in zip(np.eye(N_BIAS), hx.BIAS_SDS, strict=True):
        shift = 0.01 * sd * unit[:, None]
        by_bias.append((function(points.signals, design, point_bias + shift) - residual) / (0.01 * sd))
    return np.column_stack([by_design, *by_bias, residual])


def _weigh(columns: Array, n_samples: Array, law_sd: float) -> _Linear:
    """Weigh by sensor noise, propagated through the equation, and the model's own error."""
    usable = np.asarray(np.isfinite(columns).all(axis=1))
    columns = np.where(usable[:, None], columns, 0.0)
    noise = ((columns[:, N_DESIGN:-1] * hx.NOISE_SDS) ** 2).sum(axis=1) / np.minimum(n_samples, MAX_AVERAGED)
    return _Linear(columns, np.where(usable, 1.0 / (noise + law_sd**2), 0.0))


def _hot(points: Points, design: Array, bias: Array, health: Array, effect: float) -> _Linear:
    columns, weight = _weigh(_linearise(hx.ln_conductance_ratio, points, design, bias), points.n_samples, LAW_SD)
    square = np.where(np.isnan(health), 0.0, (columns[:, -1] - health) ** 2 * weight)
    return _Linear(columns, weight / (1.0 + square / CAUCHY_SD**2) / effect)


def _ram(points: Points, design: Array, bias: Array, *, robust: bool) -> _Linear:
    columns = _linearise(hx.ln_ram_flow_ratio, points, design, bias)
    columns, weight = _weigh(columns, points.n_samples, RAM_BALANCE_SD)
    square = columns[:, -1] ** 2 * weight if robust else np.zeros(len(weight))
    return _Linear(columns, weight / (1.0 + square / CAUCHY_SD**2) / RAM_DESIGN_EFFECT)


def _prior_terms(points: Points, design: Array) -> tuple[Array, Array]:
    """Compute normal matrix and right side of the design's prior and of the ram to pack flow prior."""

    def ratio(values: Array) -> float:
        flow = np.log(clean_ram_flow_kg_s(points.signals, values)) - np.log(points.signals["pack_flow_kg_s"])
        return float(np.nanmedian(flow))

    now = ratio(design)
    slope = np.array([(ratio(design + 1e-4 * unit) - now) / 1e-4 for unit in np.eye(N_DESIGN)])
    normal = np.diag(hx.SD**-2.0) + np.outer(slope, slope) / LN_FLOW_RATIO_SD**2
    right = (hx.MEAN - design) / hx.SD**2 + slope * (LN_FLOW_RATIO - now) / LN_FLOW_RATIO_SD**2
    return normal, right


def _flight_means(pack: _Pack, weight: Array, columns: Array) -> tuple[Array, Array]:
    """Average columns over each flight with weights; return also the weight of each flight."""
    n = len(pack.gaps) + 1
    total = np.bincount(pack.flight_of_row, weight, n) + 1e-9
    means = np.stack([np.bincount(pack.flight_of_row, weight * c, n) for c in columns.T], axis=1)
    return means / total[:, None], total


def _level_weight(per_flight: Array, effect: float) -> Array:
    """Compute the weight of a flight's mean against health, from its points and its own scatter."""
    return np.asarray(1.0 / (1.0 / per_flight + FLIGHT_SD**2 * effect))


def _first_stage(packs: Mapping[int, _Pack], hot: _Linear, instruments: Array, effect: float) -> Array:
    """Regress derivatives on the instruments, (n, p + 6): the first stage of two-stage least squares."""
    n = instruments.shape[1]
    normal, cross = 1e-9 * np.eye(n), np.zeros((n, N_DESIGN + N_BIAS))
    for pack in packs.values():
        weight = hot.weight[pack.rows]
        mean, per_flight = _flight_means(pack, weight, np.c_[instruments[pack.rows], hot.columns[pack.rows, :-1]])
        level_weight = _level_weight(per_flight, effect)
        moment = mean[:, :n].T @ ((mean - _smooth(level_weight, pack.gaps, mean, effect)) * level_weight[:, None])
        normal, cross = normal + moment[:, :n], cross + moment[:, n:]
    return np.asarray(instruments @ np.linalg.solve(normal, cross))


def _gram(pack: _Pack, hot: _Linear, ram: _Linear | None, derivatives: Array, effect: float) -> tuple[Array, Array]:
    """Compute cross products of a pack's columns with health eliminated, (p + 6 + 1) square, and health's response."""
    columns, weight = hot.columns[pack.rows], hot.weight[pack.rows]
    mean, per_flight = _flight_means(pack, weight, columns)
    deviations = columns - mean[pack.flight_of_row]
    gram = (deviations * weight[:, None]).T @ deviations
    level_weight = _level_weight(per_flight, effect)
    predictors = _flight_means(pack, weight, derivatives[pack.rows])[0]
    innovation = (predictors - _smooth(level_weight, pack.gaps, predictors, effect)) * level_weight[:, None]
    gram[:-1, :-1] += predictors.T @ innovation
    gram[:-1, -1] += innovation.T @ mean[:, -1]
    if ram is not None:
        ram_columns = ram.columns[pack.rows]
        gram += (ram_columns * ram.weight[pack.rows, None]).T @ ram_columns
    return gram, _smooth(level_weight, pack.gaps, mean, effect)


def _eliminate(gram: Array, response: Array, pack: _Pack, bias: Array) -> _Elimination:
    """Eliminate a pack's biases, for any step of the design."""
    part = slice(N_DESIGN, -1)
    factor = cho_factor(gram[part, part] + np.diag(pack.bias_sd**-2.0))
    right = -gram[part, -1] + (pack.bias_mean - bias) / pack.bias_sd**2
    return _Elimination(response, factor, gram[:N_DESIGN, part], right)


def _smooth(weight: Array, gaps: Array, values: Array, effect: float) -> Array:
    """Smooth values (flights, columns) by a random walk with these weights: a tridiagonal solve."""
    stiffness = 1.0 / (HEALTH_STEP**2 * effect * gaps)
    band = np.zeros((2, len(weight)))
    band[1] = weight
    band[1, 0] += 1.0 / FIRST_LEVEL_SD**2
    band[1, :-1] += stiffness
    band[1, 1:] += stiffness
    band[0, 1:] = -stiffness
    if not len(gaps):  # LAPACK's tridiagonal solver wants two flights
        return np.asarray(weight[:, None] * values / band[1])
    return np.asarray(solveh_banded(band, weight[:, None] * values))
