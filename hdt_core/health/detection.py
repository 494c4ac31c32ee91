"""Shift detection: a two-sided CUSUM against each unit's own learned offset, and persistence with hysteresis.

Vectorised over units and channels; flights follow one another, so no result uses later flights.
"""

from dataclasses import dataclass

import numpy as np

from hdt_core.robust import Array

PRIOR_FLIGHTS = 20.0
"""Weight of a series' prior scatter beside the unit's own, in flights."""


@dataclass(frozen=True, slots=True)
class Cusum:
    """Settings of the detector.

    Attributes
    ----------
    slack : float
        Half the shift to detect, in standard deviations.
    decide : float
        Sum at which the alarm sets. With `slack` 1 and 8 the in-control run length of normal, independent data is
        above 1e7 flights a side, which leaves the budget of one false alarm in 1,000 flights to tails and learned
        offsets.
    clear : float
        Sum at which the alarm clears.
    ceiling : float
        Upper bound of the sum, so that the alarm clears soon after a fault ends.
    clip : float
        Bound of one flight's innovation in standard deviations: two flights never raise an alarm.
    learn_flights : int
        Flights before a unit's own offset is used.
    memory_flights : int
        Time constant of the offset, so that drifts with age or season raise no alarm.
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
    """Result of the detector after each flight; every array is (units, flights, channels)."""

    alarm: Array
    """Whether a shift is detected. [bool]"""
    z: Array
    """Innovation in standard deviations, not clipped; 0 where nothing was measured."""
    departure: Array
    """Smoothed departure from the offset, in the series' unit."""
    sum_high: Array
    sum_low: Array


def watch(values: Array, prior_sd: Array, restart: Array, settings: Cusum | None = None) -> Shift:
    """Detect the shifts of every series.

    Parameters
    ----------
    values : array
        (units, flights, channels); NaN where not measured.
    prior_sd : array
        (channels,). Flight-to-flight standard deviation of a sound unit, in the series' unit. The unit's own scatter is
        averaged with it and bounded below by half of it.
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
    z, departure, high, low = (np.zeros(values.shape) for _ in range(4))
    alarm = np.zeros(values.shape, dtype=bool)
    has_restart = np.asarray(restart.any(axis=(0, 2)))
    for k in range(n_flights):
        if has_restart[k]:
            walk.restart(restart[:, k])
        z[:, k] = walk.take(values[:, k], settings)
        alarm[:, k], departure[:, k] = walk.alarm, walk.departure
        high[:, k], low[:, k] = walk.high, walk.low
    return Shift(alarm, z, departure, high, low)


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
    alarm: Array
    departure: Array

    @classmethod
    def start(cls, n_units: int, n_channels: int, prior_sd: Array) -> "_Walk":
        shape = (n_units, n_channels)
        var = np.broadcast_to(prior_sd**2, shape)
        n, spread_n, high, low, departure = (np.zeros(shape) for _ in range(5))
        alarm = np.zeros(shape, dtype=bool)
        return cls(var, np.full(shape, np.nan), n, var.copy(), spread_n, high, low, alarm, departure)

    def restart(self, new: Array) -> None:
        self.offset = np.where(new, np.nan, self.offset)
        self.n, self.departure = np.where(new, 0.0, self.n), np.where(new, 0.0, self.departure)
        self.high, self.low = np.where(new, 0.0, self.high), np.where(new, 0.0, self.low)

    def take(self, y: Array, s: Cusum) -> Array:
        """Process one flight and return its innovation in standard deviations."""
        valid = np.isfinite(y)
        self.offset = np.where(valid & np.isnan(self.offset), y, self.offset)
        innovation = np.where(valid, y - self.offset, 0.0)
        sd = np.sqrt(self.variance() * (1.0 + 1.0 / np.maximum(self.n, 1.0)))
        z = innovation / sd
        larger_sum = self._sum(np.clip(z, -s.clip, s.clip), valid & (self.n >= s.learn_flights), s)
        self.alarm = np.where(self.alarm, larger_sum > s.clear, larger_sum > s.decide)
        departure = np.where(larger_sum > 0.0, 0.8 * self.departure + 0.2 * innovation, 0.0)
        self.departure = np.where(valid, departure, self.departure)
        self._learn(valid & ~self.alarm & (larger_sum < 0.5 * s.decide), np.clip(innovation, -3.0 * sd, 3.0 * sd), s)
        return np.asarray(z)

    def variance(self) -> Array:
        own = (PRIOR_FLIGHTS * self.prior_var + self.spread_n * self.spread) / (PRIOR_FLIGHTS + self.spread_n)
        return np.asarray(np.maximum(own, 0.25 * self.prior_var))

    def _sum(self, z: Array, ripe: Array, s: Cusum) -> Array:
        self.high = np.where(ripe, np.clip(self.high + z - s.slack, 0.0, s.ceiling), self.high)
        self.low = np.where(ripe, np.clip(self.low - z - s.slack, 0.0, s.ceiling), self.low)
        return np.maximum(self.high, self.low)

    def _learn(self, calm: Array, innovation: Array, s: Cusum) -> None:
        # the first offset is one flight's value, so the second flight already scatters about it
        square = innovation**2 * self.n / (self.n + 1.0)
        weight = np.where(calm & (self.n > 0), 1.0 / np.minimum(self.spread_n + 1.0, s.memory_flights), 0.0)
        self.spread = self.spread + weight * (square - self.spread)
        self.spread_n = np.minimum(self.spread_n + (weight > 0), s.memory_flights)
        gain = 1.0 / np.minimum(self.n + 1.0, s.memory_flights)
        self.offset = np.where(calm, self.offset + gain * innovation, self.offset)
        self.n = self.n + calm


def persistent(
    flags: Array, k: int, n: int, hold: int, *, keep: Array | None = None, restart: Array | None = None
) -> Array:
    """Flag from `k` of the last `n` flights flagged until `hold` flights have passed without `keep`.

    Parameters
    ----------
    flags : array
        (units, flights), bool.
    keep : array, optional
        Weaker condition that keeps the flag set (hysteresis); `flags` where not given.
    restart : array, optional
        True on a flight before which nothing counts.

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
    flight = np.arange(flags.shape[1])
    count = np.pad(np.cumsum(flags, axis=1), ((0, 0), (1, 0)))
    # flights outside the window or before a restart do not count
    before = np.maximum(np.maximum(flight + 1 - n, _last(restart)), 0)
    is_enough = count[:, 1:] - np.take_along_axis(count, before, axis=1) >= k
    release = restart | (flight - _last(keep) >= hold)
    return np.asarray(_last(is_enough) >= np.maximum(_last(release), 0))


def _last(events: Array) -> Array:
    """Return the last event up to each flight; -1 before the first. (units, flights)"""
    return np.asarray(np.maximum.accumulate(np.where(events, np.arange(events.shape[1]), -1), axis=1))


def since(events: Array) -> Array:
    """Count flights since the last event, 0 on it; a million before the first. (units, flights)"""
    last = _last(events)
    return np.where(last < 0, 10**6, np.arange(events.shape[1]) - last)


def lingering(events: Array, flights: int) -> Array:
    """Whether an event lies at most `flights` flights back. (units, flights) bool"""
    return np.asarray(since(events) <= flights)
