"""Dynamic fit of H of equations (7)-(8) to 1 Hz logs, one parameter per flight.

Trapezoidal (Tustin) steps with the inputs held, which are stable for any mass, and the derivative by ln H carried along
in the same recursion, so that a step of Gauss-Newton costs one pass over the log.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt

from hdt_benchmark.exchanger import ExchangerSamples, FlightFits
from hdt_benchmark.exchanger_compiled import AT_BOUND, NOT_IDENTIFIABLE, Columns, Integers
from hdt_benchmark.exchanger_log_compiled import LEAST_H_W_K, MOST_H_W_K, fits, is_whole
from hdt_core.estimation.problem import Array


def fit_lumped_log(samples: ExchangerSamples, dt_s: float, mass_hot_kg: float, mass_cold_kg: float) -> FlightFits:
    r"""Fit ln H of equations (7)-(8) with H_h = H_c and known masses, one number a flight.

    Parameters
    ----------
    samples : ExchangerSamples
        Evenly spaced in time. A missing input is held at its last value (the first one backwards); a missing outlet
        temperature, or one without weight, does not count.
    dt_s : float
        Time between samples. [s]
    mass_hot_kg, mass_cold_kg : float
        Air-equivalent mass of each side, core included. [kg]

    Returns
    -------
    FlightFits
        `mean` is :math:`\ln H`, H in W/K; `at_bound` where the log calls for an H above 1e6 W/K or for none.

    Notes
    -----
    Starts from the mean sample in closed form and one step of the steady fit; then usually two passes. The log begins
    in the steady state of its first sample.
    """
    pace = (0.5 * dt_s / mass_hot_kg, 0.5 * dt_s / mass_cold_kg)
    theta, information, chi2, n_used, steps, code = fits(_fill_gaps(samples), samples.starts, pace)
    outside = (theta <= np.log(LEAST_H_W_K)) | (theta >= np.log(MOST_H_W_K))
    code[outside & (code != NOT_IDENTIFIABLE)] = AT_BOUND
    return FlightFits(theta, information, chi2, n_used, steps, code)


def _fill_gaps(samples: ExchangerSamples) -> Columns:
    """Fill gaps of the inputs with the last value within each flight; samples without one get weight 0."""
    columns = samples.columns()
    if is_whole(columns):
        return columns
    hot_flow, ram_flow, hot_in, hot_out, cold_in, weight = columns
    pairs = [_hold_last(column, samples.starts) for column in (hot_flow, ram_flow, hot_in, cold_in)]
    with np.errstate(invalid="ignore"):
        counts = np.isfinite(hot_out) & (weight > 0.0) & ~np.any([none for _, none in pairs], axis=0)
    hot_flow, ram_flow, hot_in, cold_in = (column for column, _ in pairs)
    return hot_flow, ram_flow, hot_in, np.where(counts, hot_out, 0.0), cold_in, np.where(counts, weight, 0.0)


def _hold_last(column: Array, starts: Integers) -> tuple[Array, npt.NDArray[np.bool_]]:
    with np.errstate(invalid="ignore"):
        good = (column > 0.0) & (column < np.inf)
    values, none = column.copy(), np.zeros(len(column), dtype=bool)
    for begin, end in pairwise(starts):
        at = np.flatnonzero(good[begin:end])
        if at.size == 0:
            values[begin:end], none[begin:end] = 1.0, True
            continue
        last = np.clip(np.searchsorted(at, np.arange(end - begin), side="right") - 1, 0, None)
        values[begin:end] = column[begin:end][at[last]]
    return values, none
