"""Batched fits of one parameter per flight to heat exchanger samples.

Each flight is its own least-squares fit of the hot outlet temperature by one parameter: maximum likelihood and
information, which is all that a later pass along the flights needs. Gauss-Newton from a closed-form start, so no flight
waits for another, and a flight's answer does not depend on its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hdt_benchmark.exchanger_compiled import Columns, conductance_scale, lumped_resistance
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
        return (
            np.ascontiguousarray(self.hot_flow_kg_s, dtype=float),
            np.ascontiguousarray(self.ram_flow_kg_s, dtype=float),
            np.ascontiguousarray(self.hot_in_k, dtype=float),
            np.ascontiguousarray(self.hot_out_k, dtype=float),
            np.ascontiguousarray(self.cold_in_k, dtype=float),
            np.ascontiguousarray(self.weight_per_k2, dtype=float),
        )


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

    The start is Newton's method on each flight's mean sample. Status and answer come per flight: a batch, and the same
    flights one by one, agree to the last digits.
    """
    clean = np.ascontiguousarray(clean_ua_w_k, dtype=float)
    return FlightFits(*conductance_scale(samples.columns(), clean, samples.starts))


def fit_lumped_resistance(samples: ExchangerSamples) -> FlightFits:
    r"""Fit 1/H of equations (7)-(8) with H_h = H_c in steady flow, one number a flight.

    Returns
    -------
    FlightFits
        `mean` is 1/H. [K/W] Status `at_bound` where it is 0 or less: the flight's exchanger is more effective than
        these equations allow, and no H explains it. It is the inverse that is fitted, since H passes through infinity
        there while the residuals are smooth in 1/H.

    Notes
    -----
    .. math:: \varepsilon_h = \left[1 + W_h C_h \left(\tfrac{1}{H} + \tfrac{1}{W_r C_c}\right)\right]^{-1}
    """
    return FlightFits(*lumped_resistance(samples.columns(), samples.starts))
