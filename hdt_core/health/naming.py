"""Whose sensor it is, once a cross check has left its level: all checks, weighed by their signatures."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from hdt_core.health.detection import Array, Shift
from hdt_core.health.diagnosis import CHANNELS, HX_STEP, NO_SENSOR, classify
from hdt_core.health.grid import Grid

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


@dataclass(frozen=True, slots=True)
class Evidence:
    """What the classifier may look at: shifts of the checks, the loss as each flight alone says, the other pack."""

    grid: Grid
    shift: Shift
    loss: Array
    partner: Array

    def name(self, channel: int, spell: tuple[int, int, int | None]) -> tuple[int, dict[str, Any]] | None:
        """First flight that blames a sensor of this pack with confidence, and what it says; None where none does."""
        unit, first, end = spell
        for k in range(first, min(end if end is not None else self.loss.shape[1], first + PATIENCE)):
            z, flights = self.at(unit, k, first)
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

    def at(self, unit: int, flight: int, first: int) -> tuple[Array, Array]:
        """Shifts of the last flights in their standard deviations, and flights they are worth: own channels and loss,
        then the other pack's. (2 (C + 1),) each"""
        mine = self._half(unit, flight, first)
        other = int(self.partner[unit])
        if other < 0:
            blank = np.full(len(CHANNELS) + 1, np.nan)
            return np.concatenate([mine[0], blank]), np.concatenate([mine[1], np.ones_like(blank)])
        theirs = self._half(other, *(self.same_time(unit, k, other) - 1 for k in (flight, first)))
        return np.concatenate([mine[0], theirs[0]]), np.concatenate([mine[1], theirs[1]])

    def same_time(self, unit: int, flight: int, other: int) -> int:
        """How many flights the other pack had recorded by this one's departure."""
        departed = self.grid.rows["departed_at"].to_physical().to_numpy()
        own, start, stop = np.searchsorted(self.grid.unit, [unit, other, other + 1])
        return int(np.searchsorted(departed[start:stop], departed[own + flight], side="right"))

    def _half(self, unit: int, flight: int, first: int) -> tuple[Array, Array]:
        run = int(np.clip(flight - first + AT_LEAST, AT_LEAST, LATEST))
        late = slice(max(flight - run + 1, 0), flight + 1)
        z, flights = _median_z(self.shift.z[unit, late])
        gained, worth = self._gained(unit, late, first)
        return np.append(z, gained), np.append(flights, worth)

    def _gained(self, unit: int, late: slice, first: int) -> tuple[float, float]:
        """Loss of the late flights above that before the shift, in its standard deviations; flights it is worth."""
        before = slice(max(first - GAP - BEFORE, 0), max(first - GAP, 0))
        now, then = (v[np.isfinite(v)] for v in (self.loss[unit, late], self.loss[unit, before]))
        if not now.size or not then.size:
            return np.nan, 1.0
        between = 0.5 * (late.start + late.stop - before.start - before.stop)
        sampling = HX_STEP.sd**2 / MEDIAN_WORTH * (1.0 / now.size + 1.0 / then.size)
        sd = float(np.sqrt(sampling + (WEAR_SD * between) ** 2))
        return float(np.median(now) - np.median(then)) / sd, (HX_STEP.sd / sd) ** 2


def _median_z(z: Array) -> tuple[Array, Array]:
    """Median of the flights, in standard deviations of that median, and flights it is worth; (channels,) each, NaN
    where never measured."""
    seen = np.where(np.isfinite(z) & (z != 0.0), z, np.nan)
    # what was not measured comes last, and a row of it stands for no flights at all
    ordered = np.sort(np.vstack([seen, np.full(z.shape[1], np.nan)]), axis=0)
    n = np.isfinite(ordered).sum(axis=0)
    worth = np.maximum(np.where(n > 2, MEDIAN_WORTH * n, n), 1e-9)
    low, high = (np.take_along_axis(ordered, k[None], axis=0)[0] for k in (np.maximum(n - 1, 0) // 2, n // 2 * (n > 0)))
    return 0.5 * (low + high) * np.sqrt(worth), worth
