"""First passage of the conductance below a flight's demand: probability of the message by flight k.

Wear lowers the ln conductance ratio at an uncertain rate; each flight draws its demand from the recent distribution.
The message comes on the first flight whose demand exceeds the ratio.

References
----------
.. [1] M.-L. T. Lee and G. A. Whitmore, Threshold regression for survival analysis: modeling event times by a stochastic
   process reaching a boundary, Statistical Science 21 (4), 2006.
"""

import numpy as np
import polars as pl
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from hdt_core.margin.exchanger_demand import CRITICAL, EXCESS_K
from hdt_core.margin.margin import PRIOR_RULE, at_excess
from hdt_core.physics.model import Array
from hdt_core.records.keys import LEG, PACK, number_packs

Index = NDArray[np.int_]

WINDOW_FLIGHTS, RECENT_FLIGHTS = 150, 40
"""Flights whose demand represents future flights, and the present season."""
LEVELS = (0.5, 0.8, 0.9, 0.95, 0.98, 1.0)
"""Quantiles of the demand in the window; the last is the maximum."""
RECENT_LEVELS = (0.5, 0.9)
"""Quantiles of the recent flights."""
TREND_FLIGHTS = 100
DEMAND_NAMES = (
    *(f"asked_{round(100 * level)}" for level in LEVELS),
    *(f"asked_now_{round(100 * level)}" for level in RECENT_LEVELS),
    "asked_trend",
)


def demand_quantiles(critical: Array, pack: Index, flight: Index) -> dict[str, Array]:
    """Return quantiles and trend of the demand of a flight and those before it; flights of unknown demand don't count.

    Parameters
    ----------
    critical : array, shape (packs, flights)
        Critical ln conductance ratio of each flight of each pack, NaN where unknown. [-]
    pack, flight : array of int, shape (n,)
        Flights to evaluate.

    Returns
    -------
    dict of str to array
        `DEMAND_NAMES`: quantiles `LEVELS` over the window and `RECENT_LEVELS` over the recent flights; `asked_trend`,
        mean of the recent ones less that of those a hundred flights before, 0 while fewer are known. NaN before the
        first known flight.
    """
    is_known = np.isfinite(critical)
    n_flights = np.cumsum(is_known, axis=1)[pack, flight]
    known_first = np.argsort(~is_known, axis=1, kind="stable")
    demand = np.take_along_axis(critical, known_first, axis=1)
    last = n_flights - 1
    window = np.sort(_past(demand, pack, last, n_flights, WINDOW_FLIGHTS), axis=1)
    recent = np.sort(_past(demand, pack, last, n_flights, RECENT_FLIGHTS), axis=1)
    earlier = _past(demand, pack, last - TREND_FLIGHTS, n_flights, RECENT_FLIGHTS).mean(axis=1)
    trend = np.where(n_flights >= TREND_FLIGHTS + RECENT_FLIGHTS, recent.mean(axis=1) - earlier, 0.0)
    columns = [window[:, round(level * (WINDOW_FLIGHTS - 1))] for level in LEVELS]
    columns += [recent[:, round(level * (RECENT_FLIGHTS - 1))] for level in RECENT_LEVELS]
    return {n: np.where(n_flights > 0, v, np.nan) for n, v in zip(DEMAND_NAMES, (*columns, trend), strict=True)}


def repeated_demand(critical: Array, of: int = 3) -> Array:
    """Return the demand of two hot flights of `of`: the lower of a flight's and the highest of those just before.

    (packs, flights); with `of` 1 the flight's own. NaN on the first flight, which has none before it.
    """
    if of == 1:
        return critical
    before = np.full_like(critical, np.nan)
    for lag in range(1, of):
        before[:, lag:] = np.fmax(before[:, lag:], critical[:, :-lag])
    return np.asarray(np.minimum(critical, before))


def _past(values: Array, pack: Index, flight: Index, n_flights: Index, flights: int) -> Array:
    """Return the values of the last `flights` flights, repeated where there are fewer. (n, flights)"""
    back = np.arange(flights)[None, :] % np.maximum(n_flights, 1)[:, None]
    return np.asarray(values[pack[:, None], np.maximum(flight[:, None] - back, 0)])


RATE, RATE_SD = 0.0012, 0.0012
"""Ln conductance lost a flight, and its spread over units: a life of some 400 flights to a loss of 0.38. [1/flight]"""
NODES = ndtri((np.arange(5) + 0.5) / 5.0)
"""Standard normal nodes of equal weight for the uncertainty of the rate."""
SLOPE_SD, SLOPE_FLIGHTS = 0.010, 60.0
"""Scatter of a flight's ln ratio in a slope, and flights after which the slope's error stops falling."""
RATIO_SD = 0.012
"""Standard deviation of the ln conductance ratio. [-]"""
DEMAND_SD = 0.03
"""Standard deviation of the demand beyond its quantiles: map error and coarseness of six quantiles. [-]"""


def wear_rate(slope: Array, flights: Array, prior_rate: float = RATE, prior_sd: float = RATE_SD) -> tuple[Array, Array]:
    """Return mean and sd of the wear rate's posterior from a least-squares slope over the last flights. (n,) each

    `prior_rate` and `prior_sd` are those of a unit before its first flight. [1/flight]
    """
    n_flights = np.clip(flights, 2.0, SLOPE_FLIGHTS)
    error2 = 12.0 * SLOPE_SD**2 / n_flights**3 + (0.25 * prior_sd) ** 2
    weight = prior_sd**2 / (prior_sd**2 + error2)
    return weight * slope + (1.0 - weight) * prior_rate, np.sqrt(weight * error2)


def passage(ratio: Array, ratio_sd: Array, demand: Array, rate: Array, rate_sd: Array, edges: Array) -> Array:
    """Return P(message within `edges` flights), (n, edges), from 0 at no flights.

    Parameters
    ----------
    ratio, ratio_sd : array, shape (n,)
        Present ln conductance ratio and its standard deviation. [-]
    demand : array, shape (n, len(LEVELS))
        Quantiles `LEVELS` of the critical ratio of flights. [-]
    rate, rate_sd : array, shape (n,)
        From `wear_rate`. [1/flight]
    edges : array
        Flights from now, rising from 0.
    """
    middle = 0.5 * (edges[1:] + edges[:-1])
    span = np.diff(edges)
    rates = np.maximum(rate[:, None] + rate_sd[:, None] * NODES, 0.0)
    ratio_ahead = ratio[:, None, None] - rates[:, :, None] * middle
    sd = np.sqrt(ratio_sd**2 + DEMAND_SD**2)[:, None, None]
    hazard = np.zeros_like(ratio_ahead)
    for weight, level in zip(_weights(), demand.T, strict=True):
        hazard += weight * ndtr((level[:, None, None] - ratio_ahead) / sd)
    survival = np.exp(-np.cumsum(hazard * span, axis=2)).mean(axis=1)
    return np.concatenate([np.zeros((len(ratio), 1)), 1.0 - survival], axis=1)


def _weights() -> Array:
    """Return the share of flights that each quantile represents: half the way to its neighbours."""
    bounds = np.concatenate([[0.0], 0.5 * (np.array(LEVELS[1:]) + np.array(LEVELS[:-1])), [1.0]])
    return np.diff(bounds)


AHEAD = (100, 300)
"""Horizons of the forecast in the features. [flights]"""
EDGES = (0.0, 10.0, 25.0, 50.0, 100.0, 150.0, 200.0, 300.0)
"""Flights at which the hazard is integrated; `AHEAD` are among them."""
PASSAGES = tuple(f"hx_passage_{ahead}" for ahead in AHEAD)


def passages(flights: pl.DataFrame, demand: pl.DataFrame) -> pl.DataFrame:
    """Return P(message within `AHEAD` flights) of each exchanger after each flight, by `PRIOR_RULE`.

    Parameters
    ----------
    flights : DataFrame
        One row a flight and pack in order of departure: operator, tail, pack, flight_id, `hx_ln_ua_ratio`,
        `hx_fouling`, `hx_fouling_slope_100_per_flight`, `flights_since_drop`.
    demand : DataFrame
        Of `exchanger_demand`.

    Returns
    -------
    DataFrame
        operator, tail, flight_id, pack and `PASSAGES`; null before the first known demand. It learns from no fleet,
        so a flight's forecast never changes.
    """
    rows = flights.join(
        demand.select(*LEG, *CRITICAL[: len(EXCESS_K)]), on=LEG, how="left", maintain_order="left", validate="m:1"
    )
    if not rows.height:
        return rows.select(LEG).with_columns(pl.lit(None, pl.Float64).alias(name) for name in PASSAGES)
    pack = number_packs(rows)
    flight = rows.select(pl.int_range(pl.len()).over(PACK))[:, 0].to_numpy()
    curves = np.full((pack.max() + 1, flight.max() + 1, len(EXCESS_K)), np.nan)
    curves[pack, flight] = rows.select(CRITICAL[: len(EXCESS_K)]).to_numpy().astype(float)
    quantiles = demand_quantiles(repeated_demand(at_excess(curves, PRIOR_RULE.excess_k), PRIOR_RULE.of), pack, flight)
    ratio, loss, slope, flights_before = (
        rows[c].cast(pl.Float64).to_numpy()
        for c in ("hx_ln_ua_ratio", "hx_fouling", "hx_fouling_slope_100_per_flight", "flights_since_drop")
    )
    n_flights = np.where(np.isnan(slope), 2.0, flights_before + 1.0)
    rate = wear_rate(np.nan_to_num(slope) / np.maximum(1.0 - loss, 0.2), n_flights)
    levels = np.stack([quantiles[name] for name in DEMAND_NAMES[: len(LEVELS)]], axis=1)
    chance = passage(ratio, np.full(ratio.size, RATIO_SD), levels, *rate, np.array(EDGES))
    columns = [
        pl.Series(name, chance[:, at]).fill_nan(None)
        for name, at in zip(PASSAGES, map(EDGES.index, AHEAD), strict=True)
    ]
    return rows.select(LEG).with_columns(columns)
