"""When the conductance that is left first falls below what a flight asks: probability of the message by flight k.

Wear takes the ln conductance ratio down, at a rate known with some doubt; each flight draws what it asks from the
conditions of late. The message comes on the first flight that asks for more than is left.

References
----------
.. [1] M.-L. T. Lee and G. A. Whitmore, Threshold regression for survival analysis: modeling event times by a stochastic
   process reaching a boundary, Statistical Science 21 (4), 2006.
"""

import numpy as np
import polars as pl
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from hdt_core.margin.conditions import ASKED, LEVELS, asked, repeated
from hdt_core.margin.exchanger_demand import CRITICAL, EXCESS_K
from hdt_core.margin.margin import PRIOR_RULE, at_excess
from hdt_core.records.keys import LEG

Array = NDArray[np.float64]

RATE, RATE_SD = 0.0012, 0.0012
"""Ln conductance lost a flight, and its spread over units: a life of some 400 flights to a loss of 0.38. [1/flight]"""
NODES = ndtri((np.arange(5) + 0.5) / 5.0)
"""Standard normal nodes of equal weight that stand for the doubt about the rate."""
SLOPE_SD, SLOPE_FLIGHTS = 0.010, 60.0
"""Scatter of a flight's ln ratio that a slope is taken from, and flights after which its error stops falling."""
LEFT_RATIO_SD = 0.012
"""What is not known of the ratio that is left, beside what `ASK_SD` says of the question. [-]"""
ASK_SD = 0.03
"""What the quantiles of a window leave out: the map's error and the coarseness of six quantiles. [-]"""


def wear_rate(slope: Array, flights: Array, usual: float = RATE, usual_sd: float = RATE_SD) -> tuple[Array, Array]:
    """Posterior of the wear rate from a least-squares slope over the last flights: mean and sd. (n,) each

    `usual` and `usual_sd` are what is believed of a unit before it has flown. [1/flight]
    """
    seen = np.clip(flights, 2.0, SLOPE_FLIGHTS)
    error2 = 12.0 * SLOPE_SD**2 / seen**3 + (0.25 * usual_sd) ** 2
    weight = usual_sd**2 / (usual_sd**2 + error2)
    return weight * slope + (1.0 - weight) * usual, np.sqrt(weight * error2)


def passage(ratio: Array, ratio_sd: Array, asked: Array, rate: Array, rate_sd: Array, edges: Array) -> Array:
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


AHEAD = (100, 300)
"""Flights for which the features tell the physical forecast."""
PASSAGES = tuple(f"hx_passage_{ahead}" for ahead in AHEAD)


def passages(flights: pl.DataFrame, asks: pl.DataFrame) -> pl.DataFrame:
    """P(message within `AHEAD` flights) of each exchanger after each flight, by the rule that holds before any message.

    Parameters
    ----------
    flights : DataFrame
        One row a flight and pack in order of departure: operator, tail, pack, flight_id, `hx_ln_ua_ratio`,
        `hx_fouling`, `hx_fouling_slope_100_per_flight`, `flights_seen_of_unit`.
    asks : DataFrame
        Of `exchanger_demand`.

    Returns
    -------
    DataFrame
        operator, tail, flight_id, pack and `PASSAGES`; null while nothing is known. It learns from no fleet, so what
        was said of a flight never changes.
    """
    known = flights.join(
        asks.select(*LEG, *CRITICAL[: len(EXCESS_K)]), on=LEG, how="left", maintain_order="left", validate="m:1"
    )
    pack = known.select(pl.struct("operator", "tail", "pack").rank("dense").cast(pl.Int64) - 1).to_series().to_numpy()
    flight = known.select(pl.int_range(pl.len()).over("operator", "tail", "pack")).to_series().to_numpy()
    if not known.height:
        return known.select(LEG).with_columns(pl.lit(None, pl.Float64).alias(name) for name in PASSAGES)
    curves = np.full((pack.max() + 1, flight.max() + 1, len(EXCESS_K)), np.nan)
    curves[pack, flight] = known.select(CRITICAL[: len(EXCESS_K)]).to_numpy().astype(float)
    asks_now = asked(repeated(at_excess(curves, PRIOR_RULE.excess_k), PRIOR_RULE.of), pack, flight)
    ratio, loss, slope, run = (
        known[c].cast(pl.Float64).to_numpy()
        for c in ("hx_ln_ua_ratio", "hx_fouling", "hx_fouling_slope_100_per_flight", "flights_seen_of_unit")
    )
    rate = wear_rate(np.nan_to_num(slope) / np.maximum(1.0 - loss, 0.2), np.where(np.isnan(slope), 2.0, run + 1.0))
    levels = np.stack([asks_now[name] for name in ASKED[: len(LEVELS)]], axis=1)
    by = passage(
        ratio,
        np.full(ratio.size, LEFT_RATIO_SD),
        levels,
        *rate,
        np.array([0.0, 10.0, 25.0, 50.0, 100.0, 150.0, 200.0, 300.0]),
    )
    told = [pl.Series(name, by[:, at]).fill_nan(None) for name, at in zip(PASSAGES, (4, 7), strict=True)]
    return known.select(LEG).with_columns(told)
