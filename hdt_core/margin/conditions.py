"""Distribution of a pack's recent demand on its exchanger, from which the demand of future flights is drawn.

A flight's demand is a critical ln conductance ratio (`margin.exchanger_demand`): below it, too much of the flight is
above the controller's target. It does not depend on the exchanger fitted, so the distribution covers all units of a
pack.
"""

import numpy as np
from numpy.typing import NDArray

from hdt_core.physics.model import Array

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
    """Return quantiles and trend of the demand of a flight and those before it.

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
    demand = _fill_forward(critical)
    first = np.where(np.isfinite(demand).any(axis=1), np.isfinite(demand).argmax(axis=1), demand.shape[1])
    n_flights = flight - first[pack] + 1
    window = np.sort(_past(demand, pack, flight, n_flights, WINDOW_FLIGHTS), axis=1)
    recent = np.sort(_past(demand, pack, flight, n_flights, RECENT_FLIGHTS), axis=1)
    earlier = _past(demand, pack, flight - TREND_FLIGHTS, n_flights, RECENT_FLIGHTS).mean(axis=1)
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


def _fill_forward(values: Array) -> Array:
    """Return the last known value of each row, NaN before the first. (packs, flights)"""
    index = np.where(np.isfinite(values), np.arange(values.shape[1]), 0)
    return np.take_along_axis(values, np.maximum.accumulate(index, axis=1), axis=1)


def _past(values: Array, pack: Index, flight: Index, n_flights: Index, flights: int) -> Array:
    """Return the values of the last `flights` flights, repeated where there are fewer. (n, flights)"""
    back = np.arange(flights)[None, :] % np.maximum(n_flights, 1)[:, None]
    return np.asarray(values[pack[:, None], np.maximum(flight[:, None] - back, 0)])
