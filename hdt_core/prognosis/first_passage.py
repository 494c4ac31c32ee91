"""When the conductance that is left first falls below what a flight asks: probability of the message by flight k.

Wear takes the ln conductance ratio down, at a rate known with some doubt; each flight draws what it asks from the
conditions of late. The message comes on the first flight that asks for more than is left.

References
----------
.. [1] M.-L. T. Lee and G. A. Whitmore, Threshold regression for survival analysis: modeling event times by a stochastic
   process reaching a boundary, Statistical Science 21 (4), 2006.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from hdt_core.prognosis.conditions import LEVELS

Array = NDArray[np.float64]

RATE, RATE_SD = 0.0012, 0.0012
"""Ln conductance lost a flight, and its spread over units: a life of some 400 flights to a loss of 0.38. [1/flight]"""
NODES = ndtri((np.arange(5) + 0.5) / 5.0)
"""Standard normal nodes of equal weight that stand for the doubt about the rate."""
SLOPE_SD, SLOPE_FLIGHTS = 0.010, 60.0
"""Scatter of a flight's ln ratio that a slope is taken from, and flights after which its error stops falling."""
ASK_SD = 0.03
"""What the quantiles of a window leave out: the map's error and the coarseness of six quantiles. [-]"""


def wear_rate(slope: Array, flights: Array) -> tuple[Array, Array]:
    """Posterior of the wear rate from a least-squares slope over the last flights: mean and sd. (n,) each"""
    seen = np.clip(flights, 2.0, SLOPE_FLIGHTS)
    error2 = 12.0 * SLOPE_SD**2 / seen**3 + (0.25 * RATE_SD) ** 2
    weight = RATE_SD**2 / (RATE_SD**2 + error2)
    return weight * slope + (1.0 - weight) * RATE, np.sqrt(weight * error2)


def passage(
    ratio: Array, ratio_sd: Array, asked: Array, rate: Array, rate_sd: Array, edges: Array
) -> Array:
    """P(message within `edges` flights), (n, edges), from 0 at no flights.

    Parameters
    ----------
    ratio, ratio_sd : array, shape (n,)
        Ln conductance ratio that is left now, and its standard deviation. [-]
    asked : array, shape (n, len(LEVELS))
        Quantiles `conditions.LEVELS` of the critical ratio of flights. [-]
    rate, rate_sd : array, shape (n,)
        From `wear_rate`. [1/flight]
    edges : array
        Flights from now, rising from 0.
    """
    middle, span = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    rates = np.maximum(rate[:, None] + rate_sd[:, None] * NODES, 0.0)
    left = ratio[:, None, None] - rates[:, :, None] * middle
    sd = np.sqrt(ratio_sd**2 + ASK_SD**2)[:, None, None]
    hazard = np.zeros_like(left)
    for weight, level in zip(_weights(), asked.T, strict=True):
        hazard += weight * ndtr((level[:, None, None] - left) / sd)
    alive = np.exp(-np.cumsum(hazard * span, axis=2)).mean(axis=1)
    return np.concatenate([np.zeros((len(ratio), 1)), 1.0 - alive], axis=1)


def _weights() -> Array:
    """Share of flights that each quantile stands for: half the way to its neighbours."""
    bounds = np.concatenate([[0.0], 0.5 * (np.array(LEVELS[1:]) + np.array(LEVELS[:-1])), [1.0]])
    return np.diff(bounds)
