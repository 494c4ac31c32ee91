"""Batched fits of one parameter per flight to heat exchanger samples: UA of snapshots, H of equations (7)-(8) of logs.

Each flight is its own least-squares fit of the hot outlet temperature by one parameter: maximum likelihood and
information, which is all that a later pass along the flights needs. Gauss-Newton from a closed-form start, so no flight
waits for another, and a flight's answer does not depend on its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from hdt_benchmark.exchanger_compiled import AT_BOUND, NOT_IDENTIFIABLE, Columns, Integers, conductance_scale
from hdt_benchmark.exchanger_log_compiled import LEAST_H_W_K, MOST_H_W_K, fits, is_whole
from hdt_core.estimation.estimate import Status
from hdt_core.estimation.problem import Array

STATUS: tuple[Status, ...] = ("converged", "at_bound", "max_steps", "not_identifiable")


@dataclass(frozen=True, slots=True)
class ExchangerSamples:
    """Steady samples of many flights, one after another.

    Parameters
    ----------
    hot_flow_kg_s, ram_flow_kg_s : array (n_samples,)
    hot_in_k, hot_out_k, cold_in_k : array (n_samples,)
        NaN where missing; a sample with anything missing, no flow or less than 1 K between its inlets is passed over.
    weight_per_k2 : array (n_samples,)
        One over the variance of the hot outlet temperature about the model; 0 to leave a sample out.
    starts : integer array (n_flights + 1,)
        Where each flight begins, and the end of the last.
    """

    hot_flow_kg_s: Array
    ram_flow_kg_s: Array
    hot_in_k: Array
    hot_out_k: Array
    cold_in_k: Array
    weight_per_k2: Array
    starts: npt.NDArray[np.int64]

    def columns(self) -> Columns:
        """Return the samples as contiguous float arrays in the kernels' order."""
        columns = (self.hot_flow_kg_s, self.ram_flow_kg_s, self.hot_in_k, self.hot_out_k, self.cold_in_k)
        hot_flow, ram_flow, hot_in, hot_out, cold_in, weight = (
            np.ascontiguousarray(column, dtype=float) for column in (*columns, self.weight_per_k2)
        )
        return hot_flow, ram_flow, hot_in, hot_out, cold_in, weight


@dataclass(frozen=True, slots=True)
class FlightFits:
    """One estimate a flight, (n_flights,) each.

    Parameters
    ----------
    mean : array
        Maximum-likelihood estimate; NaN where the flight holds no usable sample.
    information : array
        Fisher information of the flight about it, the inverse of its variance.
    chi2 : array
        Weighted sum of squared residuals at the estimate.
    n_used : integer array
        Samples that counted.
    steps : integer array
        Gauss-Newton steps taken over the samples.
    code : integer array
        Index into `STATUS`.
    """

    mean: Array
    information: Array
    chi2: Array
    n_used: npt.NDArray[np.int64]
    steps: npt.NDArray[np.int64]
    code: npt.NDArray[np.int64]

    @property
    def sd(self) -> Array:
        """Standard deviation; infinite where the flight holds no information."""
        with np.errstate(divide="ignore"):
            return 1.0 / np.sqrt(self.information)

    @property
    def status(self) -> npt.NDArray[np.str_]:
        """Status of each fit."""
        return np.array(STATUS)[self.code]


def fit_conductance_scale(samples: ExchangerSamples, clean_ua_w_k: Array) -> FlightFits:
    r"""Fit the logarithm of UA over the clean UA, one number a flight, with the exact cross-flow effectiveness.

    Parameters
    ----------
    samples : ExchangerSamples
    clean_ua_w_k : array (n_samples,)
        Conductance that the clean exchanger would have at each sample's flows; sets the scale. [W/K]

    Returns
    -------
    FlightFits
        `mean` is :math:`\ln(UA / UA_{clean})`, within [-4, 4]: `at_bound` where no conductance explains the flight. The
        fractional loss is ``-expm1(mean)``, with standard deviation ``exp(mean) * sd``.

    Notes
    -----
    Specific heats are those of the measured temperatures (`capacity_rates`) and stay while UA is sought: that outlets
    of the model would have others changes UA by less than a thousandth of its sd, and the information by 0.5 %.

    Status and answer come per flight: a batch, and the same flights one by one, agree to the last digits.
    """
    clean = np.ascontiguousarray(clean_ua_w_k, dtype=float)
    return FlightFits(*conductance_scale(samples.columns(), clean, samples.starts))


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
    Trapezoidal (Tustin) steps with the inputs held, which are stable for any mass; the derivative by ln H is carried
    along, so a step of Gauss-Newton costs one pass over the log. Starts from the mean sample in closed form and one
    step of the steady fit; then usually two passes. The log begins in the steady state of its first sample.
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
