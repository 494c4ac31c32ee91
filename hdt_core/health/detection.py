"""When has a series moved? A two-sided CUSUM against an offset that each unit teaches it; persistence with hysteresis.

Vectorised over units and channels; only the flights are walked one after the other, so that nothing looks ahead.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
"""Floats, or booleans where the name says so."""

PRIOR_FLIGHTS = 20.0
"""Flights' worth of evidence that the expected scatter of a series counts for beside the unit's own."""


@dataclass(frozen=True, slots=True)
class Cusum:
    """Settings of the detector.

    Attributes
    ----------
    slack : float
        Half the shift worth finding, in standard deviations.
    decide : float
        Sum at which a shift is called. With `slack` 1 and 8 the in-control run length of normal, independent data is
        above 1e7 flights a side: the budget of one false alarm in 1,000 flights is left to tails and learned offsets.
    clear : float
        Sum at which it is taken back.
    ceiling : float
        The sum goes no higher, so that a fault that ends is soon seen to end.
    clip : float
        One flight says at most this many standard deviations: two flights never make a case.
    learn_flights : int
        Flights before a unit's own offset is trusted.
    memory_flights : int
        The offset forgets with this time constant, so that what drifts with age or season is no fault.
    """

    slack: float = 1.0
    decide: float = 8.0
    clear: float = 2.0
    ceiling: float = 14.0
    clip: float = 4.5
    learn_flights: int = 10
    memory_flights: int = 60


@dataclass(frozen=True, slots=True)
class Shift:
    """What the detector says after each flight; every array is (units, flights, channels)."""

    called: Array
    """A shift is believed. [bool]"""
    z: Array
    """Innovation in standard deviations, not clipped; 0 where nothing was measured."""
    departure: Array
    """Smoothed departure from the offset, in the series' unit."""
    sum_high: Array
    sum_low: Array


def watch(values: Array, prior_sd: Array, restart: Array, settings: Cusum | None = None) -> Shift:
    """Walk every series once and call the shifts.

    Parameters
    ----------
    values : array
        (units, flights, channels); NaN where a flight said nothing.
    prior_sd : array
        (channels,). Flight-to-flight standard deviation of a sound unit, in the series' unit. The unit's own scatter is
        weighed against it, and never believed below half of it.
    restart : array
        (units, flights, channels), bool. True where work on the aircraft makes the unit new to the detector.

    Notes
    -----
    Offset and scatter are learned only from flights without a call and without a rising sum.

    References
    ----------
    .. [1] E. S. Page, Continuous inspection schemes, Biometrika 41, 1954.
    """
    settings = settings or Cusum()
    n_units, n_flights, n_channels = values.shape
    walk = _Walk.start(n_units, n_channels, np.asarray(prior_sd, dtype=float))
    z, moved, high, low = (np.zeros(values.shape) for _ in range(4))
    called = np.zeros(values.shape, dtype=bool)
    renewed = np.asarray(restart.any(axis=(0, 2)))
    for k in range(n_flights):
        if renewed[k]:
            walk.restart(restart[:, k])
        z[:, k] = walk.take(values[:, k], settings)
        called[:, k], moved[:, k] = walk.on, walk.moved
        high[:, k], low[:, k] = walk.high, walk.low
    return Shift(called, z, moved, high, low)


@dataclass(slots=True)
class _Walk:
    """State between two flights; every array is (units, channels)."""

    prior_var: Array
    offset: Array
    n: Array
    spread: Array
    spread_n: Array
    high: Array
    low: Array
    on: Array
    moved: Array

    @classmethod
    def start(cls, n_units: int, n_channels: int, prior_sd: Array) -> "_Walk":
        shape = (n_units, n_channels)
        var = np.broadcast_to(prior_sd**2, shape)
        n, spread_n, high, low, moved = (np.zeros(shape) for _ in range(5))
        return cls(var, np.full(shape, np.nan), n, var.copy(), spread_n, high, low, np.zeros(shape, dtype=bool), moved)

    def restart(self, new: Array) -> None:
        self.offset = np.where(new, np.nan, self.offset)
        self.n, self.moved = np.where(new, 0.0, self.n), np.where(new, 0.0, self.moved)
        self.high, self.low = np.where(new, 0.0, self.high), np.where(new, 0.0, self.low)

    def take(self, y: Array, s: Cusum) -> Array:
        """One flight; returns its innovation in standard deviations."""
        seen = np.isfinite(y)
        self.offset = np.where(seen & np.isnan(self.offset), y, self.offset)
        miss = np.where(seen, y - self.offset, 0.0)
        sd = np.sqrt(self.variance() * (1.0 + 1.0 / np.maximum(self.n, 1.0)))
        z = miss / sd
        worst = self._sum(np.clip(z, -s.clip, s.clip), seen & (self.n >= s.learn_flights), s)
        self.on = np.where(self.on, worst > s.clear, worst > s.decide)
        smoothed = np.where(worst > 0.0, 0.8 * self.moved + 0.2 * miss, 0.0)
        self.moved = np.where(seen, smoothed, self.moved)
        self._learn(seen & ~self.on & (worst < 0.5 * s.decide), np.clip(miss, -3.0 * sd, 3.0 * sd), s)
        return np.asarray(z)

    def variance(self) -> Array:
        own = (PRIOR_FLIGHTS * self.prior_var + self.spread_n * self.spread) / (PRIOR_FLIGHTS + self.spread_n)
        return np.asarray(np.maximum(own, 0.25 * self.prior_var))

    def _sum(self, z: Array, ripe: Array, s: Cusum) -> Array:
        self.high = np.where(ripe, np.clip(self.high + z - s.slack, 0.0, s.ceiling), self.high)
        self.low = np.where(ripe, np.clip(self.low - z - s.slack, 0.0, s.ceiling), self.low)
        return np.maximum(self.high, self.low)

    def _learn(self, calm: Array, miss: Array, s: Cusum) -> None:
        # the first offset is one flight's value, so the second flight already scatters about it
        square = miss**2 * self.n / (self.n + 1.0)
        weight = np.where(calm & (self.n > 0), 1.0 / np.minimum(self.spread_n + 1.0, s.memory_flights), 0.0)
        self.spread = self.spread + weight * (square - self.spread)
        self.spread_n = np.minimum(self.spread_n + (weight > 0), s.memory_flights)
        gain = 1.0 / np.minimum(self.n + 1.0, s.memory_flights)
        self.offset = np.where(calm, self.offset + gain * miss, self.offset)
        self.n = self.n + calm


def persistent(
    flags: Array, k: int, n: int, hold: int, *, keep: Array | None = None, restart: Array | None = None
) -> Array:
    """Whether at least `k` of the last `n` flights were flagged, held until `hold` flights passed without `keep`.

    Parameters
    ----------
    flags : array
        (units, flights), bool.
    keep : array, optional
        The easier condition that holds a call once made (hysteresis); `flags` where not given.
    restart : array, optional
        True on a flight from which on everything before is forgotten.

    Returns
    -------
    array
        (units, flights), bool.

    Examples
    --------
    >>> persistent(np.array([[1, 0, 1, 0, 0, 0, 0]], dtype=bool), 2, 3, 3)[0].astype(int)
    array([0, 0, 1, 1, 1, 0, 0])
    """
    keep = flags if keep is None else flags | keep
    restart = np.zeros_like(flags) if restart is None else restart
    flight, begun = np.arange(flags.shape[1]), _last(restart)
    flagged = np.pad(np.cumsum(flags, axis=1), ((0, 0), (1, 0)))
    before = np.maximum(np.maximum(flight + 1 - n, begun), 0)  # what is older, or from before the end, counts no more
    called = flagged[:, 1:] - np.take_along_axis(flagged, before, axis=1) >= k
    let_go = restart | (flight - _last(keep) >= hold)
    return np.asarray(_last(called) >= np.maximum(_last(let_go), 0))


def _last(events: Array) -> Array:
    """The last flight, up to each, on which it was so; -1 before the first. (units, flights)"""
    return np.asarray(np.maximum.accumulate(np.where(events, np.arange(events.shape[1]), -1), axis=1))


def since(events: Array) -> Array:
    """Flights since the last event, 0 on it; a million before the first. (units, flights)"""
    last = _last(events)
    return np.where(last < 0, 10**6, np.arange(events.shape[1]) - last)


def lingering(events: Array, flights: int) -> Array:
    """Whether an event lies at most `flights` flights back. (units, flights) bool"""
    return np.asarray(since(events) <= flights)
