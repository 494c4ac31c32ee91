"""Isolate the faulty sensor after a shift of a cross check, by Bayes' rule over the signatures of all checks."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from hdt_core.alerts.grid import Grid
from hdt_core.alerts.signatures import CHANNELS, HX_STEP, NO_SENSOR, classify
from hdt_core.health.detection import Array, Shift

OWN_PROBABILITY, OTHER_PROBABILITY = 0.95, 0.99
"""Probability at which a sensor of this pack is isolated, and at which the fault is left to the other pack. [-]"""
MAX_DELAY = 100
"""Flights within which a shift must be isolated: a slow drift is a small shift at first."""
LATE_MOST, LATE_LEAST, EARLIER_FLIGHTS, GAP_FLIGHTS = 12, 4, 20, 8
"""Flights that a shift is averaged over, at most and at least; earlier flights that the loss is compared with; and
flights between, in which the shift may have begun undetected."""
MEDIAN_WORTH = 2.0 / np.pi
"""Efficiency of the median of normal values against their mean. [-]"""
WEAR_SD = 1e-3
"""Loss that wear may add from one flight to the next. [-]"""
BLOCK_FLIGHTS = 16
"""Flights evaluated together: most shifts are isolated within them."""


@dataclass(frozen=True)
class Indications:
    """Input of the classifier: shifts of the checks, estimate of loss from each flight alone, row of the other pack."""

    grid: Grid
    shift: Shift
    loss: Array
    partner: Array

    @cached_property
    def departures(self) -> Array:
        """`Grid.departures`. (units, flights)"""
        return self.grid.departures()

    def isolate(self, channel: int, run: tuple[int, int, int | None]) -> tuple[int, dict[str, Any]] | None:
        """Return the first flight that isolates a sensor of this pack, and the facts; None where none does."""
        unit, first, end = run
        # a shift still there when the record ends is flagged beyond it too, where the grid is padding
        n_flights = self.grid.count(unit)
        last = min(end if end is not None else n_flights, n_flights, first + MAX_DELAY)
        for k, z, flights in self._flight_shifts(unit, first, last):
            posterior = classify(z, flights)
            other_probability = sum(p for s, w, p in posterior if w == "other" and s not in NO_SENSOR)
            mine = [(s, w, p) for s, w, p in posterior if w != "other" and s not in NO_SENSOR]
            own_probability = sum(p for *_, p in mine)
            if other_probability > OTHER_PROBABILITY and k - first >= 5:
                return None
            if own_probability > OWN_PROBABILITY:
                sensor, whose, _ = mine[0]
                shift = {"moved": float(self.shift.departure[unit, k, channel]), "sigma": float(z[channel])}
                facts = {"sensor": sensor, "whose": whose, "p": own_probability, "biased": True}
                return k, facts | {"channel": CHANNELS[channel].name, **shift}
        return None

    def same_time(self, unit: int, flights: Array, other: int) -> Array:
        """Return the other pack's last flight by this pack's departure on each flight; -1 before its first."""
        return np.asarray(np.searchsorted(self.departures[other], self.departures[unit, flights], side="right") - 1)

    def _flight_shifts(self, unit: int, first: int, last: int) -> Iterator[tuple[int, Array, Array]]:
        """Yield each flight with its row of `shifts_at`."""
        for start in range(first, last, BLOCK_FLIGHTS):
            flights = np.arange(start, min(start + BLOCK_FLIGHTS, last))
            yield from zip(flights.tolist(), *self.shifts_at(unit, flights, first), strict=True)

    def shifts_at(self, unit: int, flights: Array, first: int) -> tuple[Array, Array]:
        """Return the shifts up to each flight in standard deviations, and the flights they are worth: own channels and
        loss, then the other pack's. (flights, 2 (C + 1)) each"""
        mine = self._pack_shifts(unit, flights, first)
        other = int(self.partner[unit])
        if other < 0:
            theirs: tuple[Array, Array] = np.full_like(mine[0], np.nan), np.ones_like(mine[1])
        else:
            *other_flights, other_first = self.same_time(unit, np.append(flights, first), other)
            theirs = self._pack_shifts(other, np.array(other_flights), int(other_first))
        z, worth = (np.concatenate(both, axis=1) for both in zip(mine, theirs, strict=True))
        return z, worth

    def _pack_shifts(self, unit: int, flights: Array, first: int) -> tuple[Array, Array]:
        """Return the shifts of one pack's checks and loss, and the flights they are worth. (flights, C + 1) each"""
        n_late = np.clip(flights - first + LATE_LEAST, LATE_LEAST, LATE_MOST)
        late = flights[:, None] - np.arange(LATE_MOST)
        late = np.where((late >= 0) & (np.arange(LATE_MOST) < n_late[:, None]), late, -1)
        z = np.where((late >= 0)[:, :, None], self.shift.z[unit, late], np.nan)
        z, worth = _median_z(z)
        step, step_worth = self._loss_step(unit, late, first)
        return np.column_stack([z, step]), np.column_stack([worth, step_worth])

    def _loss_step(self, unit: int, late: Array, first: int) -> tuple[Array, Array]:
        """Return the step of loss across the shift in standard deviations, and the flights it is worth."""
        earlier = slice(max(first - GAP_FLIGHTS - EARLIER_FLIGHTS, 0), max(first - GAP_FLIGHTS, 0))
        now, n_now = _median(np.where(late >= 0, self.loss[unit, late], np.nan)[:, :, None])
        before_loss, n_before = _median(self.loss[None, unit, earlier, None])
        comparable = (n_now[:, 0] > 0) & (n_before[0, 0] > 0)
        earliest = np.where(late >= 0, late, late.max(axis=1, keepdims=True)).min(axis=1)
        distance = 0.5 * (earliest + late.max(axis=1) + 1 - earlier.start - earlier.stop)
        sampling = HX_STEP.sd**2 / MEDIAN_WORTH * (1.0 / np.maximum(n_now[:, 0], 1) + 1.0 / max(int(n_before[0, 0]), 1))
        sd = np.sqrt(sampling + (WEAR_SD * distance) ** 2)
        step = np.where(comparable, (now[:, 0] - before_loss[0, 0]) / sd, np.nan)
        return step, np.where(comparable, (HX_STEP.sd / sd) ** 2, 1.0)


def _median_z(z: Array) -> tuple[Array, Array]:
    """Return the median over flights (last axis but one) in its standard deviations, and the flights it is worth; NaN
    where never measured. (..., channels) each"""
    middle, n = _median(np.where(z != 0.0, z, np.nan))
    worth = np.maximum(np.where(n > 2, MEDIAN_WORTH * n, n), 1e-9)
    return middle * np.sqrt(worth), worth


def _median(values: Array) -> tuple[Array, Array]:
    """Return median and number of the finite values over the last axis but one; NaN where there are none."""
    # NaN sorts last, and a row of NaN covers the case of no flights
    none = np.full((*values.shape[:-2], 1, values.shape[-1]), np.nan)
    rising = np.sort(np.concatenate([np.where(np.isfinite(values), values, np.nan), none], axis=-2), axis=-2)
    n = np.isfinite(rising).sum(axis=-2)
    sides = (np.maximum(n - 1, 0) // 2, n // 2 * (n > 0))
    low, high = (np.take_along_axis(rising, k[..., None, :], axis=-2)[..., 0, :] for k in sides)
    return 0.5 * (low + high), n
