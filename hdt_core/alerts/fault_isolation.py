"""Whose sensor it is, once a cross check has left its level: all checks, weighed by their signatures."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from hdt_core.alerts.grid import Grid
from hdt_core.alerts.signatures import CHANNELS, HX_STEP, NO_SENSOR, classify
from hdt_core.health.detection import Array, Shift

SURE, SURE_NOT = 0.95, 0.99
"""Probability at which a sensor is named, and at which the other pack's is believed to be the culprit."""
PATIENCE = 100
"""Flights that a shift may wait for its name: a slow drift is a small shift at first."""
LATEST, AT_LEAST, BEFORE, GAP = 12, 4, 20, 8
"""Flights that a shift is measured over, at most and at least; those before it that the loss is held against, and how
many lie between, in which the shift may have begun unseen."""
MEDIAN_WORTH = 2.0 / np.pi
"""Of n normal values, a median is worth this share of them; and a spike is worth nothing."""
WEAR_SD = 1e-3
"""Loss that wear may add from one flight to the next. [-]"""
AT_ONCE = 16
"""Flights that are looked at together: most shifts have their name by then."""


@dataclass(frozen=True)
class Indications:
    """What the classifier may look at: shifts of the checks, the loss as each flight alone says, the other pack."""

    grid: Grid
    shift: Shift
    loss: Array
    partner: Array

    @cached_property
    def departed(self) -> Array:
        """When each flight left, (units, flights), as `Grid.departures` tells it."""
        return self.grid.departures()

    def name(self, channel: int, spell: tuple[int, int, int | None]) -> tuple[int, dict[str, Any]] | None:
        """First flight that blames a sensor of this pack with confidence, and what it says; None where none does."""
        unit, first, end = spell
        # a shift still there when the record ends is called beyond it too, where the grid is but padding
        flown = self.grid.count(unit)
        last = min(end if end is not None else flown, flown, first + PATIENCE)
        for k, z, flights in self._along(unit, first, last):
            told = classify(z, flights)
            other = sum(p for s, w, p in told if w == "other" and s not in NO_SENSOR)
            mine = [(s, w, p) for s, w, p in told if w != "other" and s not in NO_SENSOR]
            sure = sum(p for *_, p in mine)
            if other > SURE_NOT and k - first >= 5:
                return None
            if sure > SURE:
                sensor, whose, _ = mine[0]
                moved = {"moved": float(self.shift.moved[unit, k, channel]), "sigma": float(z[channel])}
                facts = {"sensor": sensor, "whose": whose, "p": sure, "biased": True}
                return k, facts | {"channel": CHANNELS[channel].name, **moved}
        return None

    def same_time(self, unit: int, flights: Array, other: int) -> Array:
        """Last flight that the other pack had recorded by this one's departure on each; -1 before its first."""
        return np.asarray(np.searchsorted(self.departed[other], self.departed[unit, flights], side="right") - 1)

    def _along(self, unit: int, first: int, last: int) -> Iterator[tuple[int, Array, Array]]:
        """Each flight with what `at` says of it."""
        for start in range(first, last, AT_ONCE):
            flights = np.arange(start, min(start + AT_ONCE, last))
            yield from zip(flights.tolist(), *self.at(unit, flights, first), strict=True)

    def at(self, unit: int, flights: Array, first: int) -> tuple[Array, Array]:
        """Shifts up to each of some flights in their standard deviations, and flights they are worth: own channels and
        loss, then the other pack's. (flights, 2 (C + 1)) each"""
        mine = self._half(unit, flights, first)
        other = int(self.partner[unit])
        if other < 0:
            theirs: tuple[Array, Array] = np.full_like(mine[0], np.nan), np.ones_like(mine[1])
        else:
            *then, began = self.same_time(unit, np.append(flights, first), other)
            theirs = self._half(other, np.array(then), int(began))
        z, worth = (np.concatenate(both, axis=1) for both in zip(mine, theirs, strict=True))
        return z, worth

    def _half(self, unit: int, flights: Array, first: int) -> tuple[Array, Array]:
        run = np.clip(flights - first + AT_LEAST, AT_LEAST, LATEST)
        late = flights[:, None] - np.arange(LATEST)
        late = np.where((late >= 0) & (np.arange(LATEST) < run[:, None]), late, -1)
        z = np.where((late >= 0)[:, :, None], self.shift.z[unit, late], np.nan)
        z, worth = _median_z(z)
        gained, gained_worth = self._gained(unit, late, first)
        return np.column_stack([z, gained]), np.column_stack([worth, gained_worth])

    def _gained(self, unit: int, late: Array, first: int) -> tuple[Array, Array]:
        """Loss of the late flights above that before the shift, in its standard deviations; flights it is worth."""
        before = slice(max(first - GAP - BEFORE, 0), max(first - GAP, 0))
        now, n_now = _median(np.where(late >= 0, self.loss[unit, late], np.nan)[:, :, None])
        then, n_then = _median(self.loss[None, unit, before, None])
        counted = (n_now[:, 0] > 0) & (n_then[0, 0] > 0)
        begun = np.where(late >= 0, late, late.max(axis=1, keepdims=True)).min(axis=1)
        between = 0.5 * (begun + late.max(axis=1) + 1 - before.start - before.stop)
        sampling = HX_STEP.sd**2 / MEDIAN_WORTH * (1.0 / np.maximum(n_now[:, 0], 1) + 1.0 / max(int(n_then[0, 0]), 1))
        sd = np.sqrt(sampling + (WEAR_SD * between) ** 2)
        gained = np.where(counted, (now[:, 0] - then[0, 0]) / sd, np.nan)
        return gained, np.where(counted, (HX_STEP.sd / sd) ** 2, 1.0)


def _median_z(z: Array) -> tuple[Array, Array]:
    """Median over flights (last axis but one), in standard deviations of that median, and flights it is worth; NaN
    where never measured. (..., channels) each"""
    middle, n = _median(np.where(z != 0.0, z, np.nan))
    worth = np.maximum(np.where(n > 2, MEDIAN_WORTH * n, n), 1e-9)
    return middle * np.sqrt(worth), worth


def _median(values: Array) -> tuple[Array, Array]:
    """Median over the last axis but one of what is known, NaN where nothing is, and how many are."""
    # what was not measured comes last, and a row of it stands for no flights at all
    none = np.full((*values.shape[:-2], 1, values.shape[-1]), np.nan)
    ordered = np.sort(np.concatenate([np.where(np.isfinite(values), values, np.nan), none], axis=-2), axis=-2)
    n = np.isfinite(ordered).sum(axis=-2)
    sides = (np.maximum(n - 1, 0) // 2, n // 2 * (n > 0))
    low, high = (np.take_along_axis(ordered, k[..., None, :], axis=-2)[..., 0, :] for k in sides)
    return 0.5 * (low + high), n
