"""What the flights of a pack have asked of its exchanger of late: the conditions that flights to come are drawn from.

A flight asks for a critical ln conductance ratio (`margin.exchanger_demand`): below it, enough of the flight is spent
above the level the controller should hold. How often that was asked, and how much, does not depend on the exchanger
that flew; so it is kept by pack, over all of its units.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int_]

WINDOW, RECENT = 150, 40
"""Flights whose conditions stand for those to come, and for those of the season's moment."""
LEVELS = (0.5, 0.8, 0.9, 0.95, 0.98, 1.0)
"""Quantiles of what was asked in the window that are kept; the last is the most."""
NOW = (0.5, 0.9)
"""Quantiles of the recent flights."""
TREND_FLIGHTS = 100
ASKED = (
    *(f"asked_{round(100 * level)}" for level in LEVELS),
    *(f"asked_now_{round(100 * level)}" for level in NOW),
    "asked_trend",
)


def asked(critical: Array, pack: Index, flight: Index) -> dict[str, Array]:
    """What was asked of late, from a flight and those before it.

    Parameters
    ----------
    critical : array, shape (packs, flights)
        Critical ln conductance ratio of each flight of each pack, NaN where unknown. [-]
    pack, flight : array of int, shape (n,)
        Which flights are asked about.

    Returns
    -------
    dict of str to array
        `ASKED`: quantiles `LEVELS` over the window and `NOW` over the recent flights; `asked_trend`, mean of the recent
        ones less that of those a hundred flights before, 0 while fewer are known. NaN before the first known flight.
    """
    known = _fill_forward(critical)
    first = np.where(np.isfinite(known).any(axis=1), np.isfinite(known).argmax(axis=1), known.shape[1])
    seen = flight - first[pack] + 1
    window = np.sort(_past(known, pack, flight, seen, WINDOW), axis=1)
    recent = np.sort(_past(known, pack, flight, seen, RECENT), axis=1)
    earlier = _past(known, pack, flight - TREND_FLIGHTS, seen, RECENT).mean(axis=1)
    trend = np.where(seen >= TREND_FLIGHTS + RECENT, recent.mean(axis=1) - earlier, 0.0)
    columns = [window[:, round(level * (WINDOW - 1))] for level in LEVELS]
    columns += [recent[:, round(level * (RECENT - 1))] for level in NOW]
    return {n: np.where(seen > 0, v, np.nan) for n, v in zip(ASKED, (*columns, trend), strict=True)}


def repeated(critical: Array, of: int = 3) -> Array:
    """What two hot flights of `of` must have asked: the lower of a flight's and the most of those just before.

    (packs, flights); with `of` 1 the flight's own. NaN on the first flight, which has none before it.
    """
    if of == 1:
        return critical
    before = np.full_like(critical, np.nan)
    for lag in range(1, of):
        before[:, lag:] = np.fmax(before[:, lag:], critical[:, :-lag])
    return np.asarray(np.minimum(critical, before))


def _fill_forward(values: Array) -> Array:
    """Last known value of each row, NaN before the first. (packs, flights)"""
    known = np.where(np.isfinite(values), np.arange(values.shape[1]), 0)
    return np.take_along_axis(values, np.maximum.accumulate(known, axis=1), axis=1)


def _past(values: Array, pack: Index, flight: Index, seen: Index, flights: int) -> Array:
    """Values of the last `flights` flights; where fewer have been seen, they are repeated. (n, flights)"""
    back = np.arange(flights)[None, :] % np.maximum(seen, 1)[:, None]
    return np.asarray(values[pack[:, None], np.maximum(flight[:, None] - back, 0)])
