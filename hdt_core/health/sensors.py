"""Sensor faults: silent, frozen, or gone from what physics ties them to."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from hdt_core.health.detection import Array, Cusum, Shift, persistent, watch
from hdt_core.health.diagnosis import CHANNELS, HX_STEP_SD, classify
from hdt_core.health.episodes import REPAIR, Case, Limits, spells
from hdt_core.health.grid import Grid
from hdt_core.health.witnesses import SENSORS

DOOR_MOVES = ("hx_out_minus_target_k", "hx_out_between_packs_k")
"""Checks that a faulty door moves as well as a faulty sensor."""
SURE, SURE_NOT = 0.95, 0.99
"""Probability at which a sensor is named, and at which the other pack's is believed to be the culprit."""
PATIENCE = 30
"""Flights that a shift may wait for its name."""
ECHO = 12
"""Flights by which the shift of a sensor may precede or outlast its silence without being news."""


def sensor_cases(grid: Grid, maintenance: pl.DataFrame, limits: Limits, door_on: Array) -> list[Case]:
    """Cases of all sensors; `door_on` (units, flights) tells where a door fault already explains the outlet."""
    ended = grid.worked_on(maintenance, ("SENSOR",), REPAIR)
    mute = {sensor: _mute(grid, sensor, limits) for sensor in SENSORS}
    silent = [c for sensor in SENSORS for c in _silent(grid, sensor, mute[sensor], ended, limits)]
    return silent + [c for c in _shifted(grid, maintenance, door_on, mute) if not _echo(c, silent)]


def outlet_doubtful(grid: Grid) -> Array:
    """Flights about which left and right outlet differ as they never did: not an exchanger's doing, whosever it is."""
    gap = np.where(grid.flags("running"), grid.values("w_hx_out_between_packs_k"), np.nan)[:, :, None]
    sd = np.array([c.sd for c in CHANNELS if c.name == "hx_out_between_packs_k"])
    z = watch(gap, sd, np.zeros(gap.shape, dtype=bool), Cusum(learn_flights=5)).z[:, :, 0]
    return persistent(np.abs(z) > 2.5, 2, 3, 10)


def _mute(grid: Grid, sensor: str, limits: Limits) -> Array:
    """Flights on which a sensor that has spoken before is empty too often, or shows one value. (units, flights) bool"""
    lost, still = grid.values(f"{sensor}_lost_share"), grid.flags(f"{sensor}_still")
    spoke = np.cumsum(np.nan_to_num(lost, nan=1.0) < 0.5, axis=1) >= 3
    empty = spoke & (lost > limits.lost) & (lost * grid.values("n_snapshots") >= 4)
    return grid.flags("running") & (empty | still)


def _silent(grid: Grid, sensor: str, mute: Array, ended: Array, limits: Limits) -> Iterator[Case]:
    lost, still = grid.values(f"{sensor}_lost_share"), grid.flags(f"{sensor}_still")
    keep = lost > limits.lost / 3.0
    for unit, first, end in spells(persistent(mute, 2, 3, 8, keep=keep, ended=ended), ended):
        kind = "frozen" if still[unit, first] or lost[unit, first] > 0.95 else "dropout"
        facts = {"sensor": sensor, "kind": kind, "since": max(first - 1, 0), "share": float(lost[unit, first])}
        yield Case(unit, "SENSOR", "SENSOR_FAULT", first, end, facts)


def _echo(case: Case, silent: list[Case]) -> bool:
    """Whether a shift only repeats what is known of a silent or frozen sensor."""
    same = [s for s in silent if s.unit == case.unit and s.facts["sensor"] == case.facts["sensor"]]
    return any(s.raised - ECHO <= case.raised and (s.closed is None or case.raised <= s.closed + ECHO) for s in same)


def _shifted(grid: Grid, maintenance: pl.DataFrame, door_on: Array, mute: dict[str, Array]) -> list[Case]:
    """Drifts and steps: a cross check leaves its unit's own level, and its signature says whose sensor did it."""
    running, ended = grid.flags("running"), grid.worked_on(maintenance, ("SENSOR",), REPAIR)
    values = np.stack([np.where(running, grid.values(f"w_{c.name}"), np.nan) for c in CHANNELS], axis=2)
    # what a silent sensor still says is no evidence against others
    for k, check in enumerate(CHANNELS):
        for sensor in check.moves:
            dumb = mute[sensor] | (grid.across(mute[sensor]) if check.between else False)
            values[dumb, k] = np.nan
    # a faulty door moves the outlet too, and through the difference the other pack's check
    outlet = np.array([c.name in DOOR_MOVES for c in CHANNELS])
    values[(door_on | grid.across(door_on))[:, :, None] & outlet] = np.nan
    repaired = grid.worked_on(maintenance, ("RAM_DOOR",), REPAIR)
    new = ended[:, :, None] | ((repaired | grid.across(repaired))[:, :, None] & outlet)
    shift = watch(values, np.array([c.sd for c in CHANNELS]), new)
    step = grid.values("hx_fouling_step_3") / HX_STEP_SD
    evidence = _Evidence(grid, shift, np.stack([step, grid.across(step)]), grid.partner())
    cases = []
    for channel in range(len(CHANNELS)):
        for unit, first, end in spells(shift.called[:, :, channel], np.zeros_like(ended)):
            named = _name(evidence, channel, (unit, first, end))
            if named is not None:
                flight, facts = named
                cases.append(
                    Case(unit, "SENSOR", "SENSOR_FAULT", flight, end, facts | {"since": first, "kind": "shift"})
                )
    return _one_each(cases, evidence.partner)


def _one_each(cases: list[Case], partner: Array) -> list[Case]:
    """One case for one fault: several checks may find it, and a left-minus-right one finds it twice."""
    kept: list[Case] = []
    for case in sorted(cases, key=lambda c: (c.raised, -c.facts["p"])):
        units = (case.unit, int(partner[case.unit]))
        same = [c for c in kept if c.unit in units and c.facts["sensor"] == case.facts["sensor"]]
        open_yet = [c for c in same if c.closed is None or case.raised <= c.closed + ECHO]
        if not open_yet:
            kept.append(case)
        elif open_yet[0].unit == case.unit and open_yet[0].closed is not None:
            open_yet[0].closed = None if case.closed is None else max(open_yet[0].closed, case.closed)
    return kept


@dataclass(frozen=True, slots=True)
class _Evidence:
    """What the classifier may look at."""

    grid: Grid
    shift: Shift
    step: Array
    partner: Array

    def at(self, unit: int, flight: int, run: int) -> Array:
        """Mean shifts over the last `run` flights: own channels and step, then the other pack's."""
        mine = _mean_z(self.shift.z[unit, max(flight - run + 1, 0) : flight + 1])
        theirs, partner = np.full(len(CHANNELS), np.nan), int(self.partner[unit])
        if partner >= 0:
            last = self._same_time(unit, flight, partner)
            theirs = _mean_z(self.shift.z[partner, max(last - run, 0) : last])
        return np.concatenate([mine, [self.step[0, unit, flight]], theirs, [self.step[1, unit, flight]]])

    def _same_time(self, unit: int, flight: int, partner: int) -> int:
        """How many flights the other pack had recorded by this one's departure."""
        when = self.grid.at("departed_at", unit, flight)
        start, stop = np.searchsorted(self.grid.unit, [partner, partner + 1])
        departed = self.grid.rows["departed_at"].slice(int(start), int(stop - start))
        return int((departed <= when).sum())


def _name(evidence: _Evidence, channel: int, spell: tuple[int, int, int | None]) -> tuple[int, dict[str, Any]] | None:
    """First flight that names a sensor of this pack with confidence, and what it says; None where none does."""
    shift, (unit, first, end) = evidence.shift, spell
    for k in range(first, min(end if end is not None else shift.called.shape[1], first + PATIENCE)):
        z = evidence.at(unit, k, int(np.clip(k - first + 4, 4, 12)))
        sensor, whose, p = classify(z)[0]
        if p > SURE_NOT and whose == "other" and k - first >= 5:
            return None
        if p > SURE and whose != "other" and sensor != "hx":
            moved = {"moved": float(shift.moved[unit, k, channel]), "sigma": float(z[channel])}
            return k, {"sensor": sensor, "p": p, "biased": True, "channel": CHANNELS[channel].name, **moved}
    return None


def _mean_z(z: Array) -> Array:
    """Mean of the flights, in standard deviations of that mean; (channels,), NaN where never measured."""
    n = (z != 0.0).sum(axis=0)
    return np.where(n > 0, np.clip(z, -5.0, 5.0).sum(axis=0) / np.sqrt(np.maximum(n, 1)), np.nan)
