"""Normal behaviour of a set of sensors, and the product's detector on departures from it.

Each sensor is foretold from all others by their covariance on normal rows (shrunk, Ledoit and Wolf 2004); what is left,
in standard deviations, goes to the CUSUM that watches a pack's witnesses.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.covariance import LedoitWolf

from hdt_core.health.detection import Cusum, watch

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

LONG = 10**6
"""Rows; the offset learned on normal rows is kept."""
LEARN_SHARE, BLOCKS = 0.5, (10, 30, 60)
"""Of the normal rows the first teach what a sensor should say, the others how far its residual wanders in blocks."""
STILL = 1e-9
TAIL = 1000


@dataclass(frozen=True, slots=True)
class Normal:
    """Learned from normal rows."""

    mean: Array
    spread: Array
    precision: Array

    def residuals(self, rows: Array) -> Array:
        """Return each sensor minus its prediction from the others, in standard deviations; NaN stays NaN."""
        z = np.clip((rows - self.mean) / self.spread, -50.0, 50.0)
        own = np.sqrt(np.diag(self.precision))
        predicted = (np.nan_to_num(z) @ self.precision) / own
        return np.where(np.isnan(z), np.nan, predicted)


def learn(rows: Array) -> Normal:
    """Mean, spread and precision of normal rows; a sensor that never moves says nothing."""
    mean, spread = np.nanmean(rows, axis=0), np.nanstd(rows, axis=0)
    spread = np.where(spread > STILL, spread, np.inf)
    z = np.nan_to_num((rows - mean) / spread)
    return Normal(mean, spread, LedoitWolf().fit(z + 1e-6 * _jitter(z.shape)).precision_)


def alarms(train: Array, test: Array, settings: Cusum | None = None) -> Flags:
    """Return the rows of `test` on which a sensor shift is detected.

    The detector learns offset and scatter on the last `TAIL` rows of `train`.
    """
    settings = settings or Cusum(memory_flights=LONG)
    split = int(LEARN_SHARE * len(train))
    normal = learn(train[:split])
    scale = wander(normal.residuals(train[split:]))
    z = np.concatenate([normal.residuals(train[-TAIL:]), normal.residuals(test)])[None] / scale
    prior = np.ones(z.shape[2])
    watch_result = watch(z, prior, np.zeros(z.shape, dtype=bool), settings)
    return np.asarray(watch_result.alarm[0, -len(test) :].any(axis=1)) if len(test) else np.zeros(0, dtype=bool)


def wander(residuals: Array) -> Array:
    """How much more the mean of a block of rows scatters than independent rows would; at least 1, of each sensor.

    A CUSUM takes rows for independent; those of a process seldom are.
    """
    scatter = np.ones(residuals.shape[1])
    for rows in BLOCKS:
        blocks = np.nan_to_num(residuals[: len(residuals) // rows * rows]).reshape(-1, rows, residuals.shape[1])
        scatter = np.fmax(scatter, np.sqrt(rows * (blocks.mean(axis=1) ** 2).mean(axis=0)))
    return scatter


def _jitter(shape: tuple[int, ...]) -> Array:
    """So that a sensor that stands still has a variance at all."""
    return np.random.default_rng(0).standard_normal(shape)
