"""Sensor faults: silent, frozen, or gone from what physics ties them to."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import polars as pl

from hdt_core.alerts.cases import REPAIR, Case, Limits, spells
from hdt_core.alerts.fault_isolation import Indications
from hdt_core.alerts.grid import Grid
from hdt_core.alerts.signatures import CHANNELS, HX_STEP, SHARED
from hdt_core.health.detection import Array, Cusum, persistent, watch
from hdt_core.health.sensor_checks import SENSORS

DOOR_MOVES = ("hx_out_minus_target_k", "hx_out_between_packs_k")
"""Checks that a faulty door of this pack or the other moves as well as a faulty sensor."""
BEHIND_DOOR = ("hx_in_over_discharge_k", "hx_in_over_pressure_k", "conductance_off_cruise_ln")
"""Checks whose laws were never seen where a jammed door may stand."""
NEW_WITH = {"HX": BEHIND_DOOR, "CC": ("hx_in_over_pressure_k",)}
"""Checks that are another unit's once a part is replaced or washed: its ram side, its efficiency."""
ECHO = 12
"""Flights by which the shift of a sensor may precede or outlast its silence without being news."""


def sensor_cases(grid: Grid, maintenance: pl.DataFrame, limits: Limits, door_on: Array, jammed: Array) -> list[Case]:
    """Cases of all sensors; `door_on` (units, flights) tells where a door fault already explains the outlet, `jammed`
    where the door is stuck."""
    ended = grid.worked_on(maintenance, ("SENSOR",), REPAIR)
    mute = _mute(grid, limits)
    silent = [c for sensor in SENSORS for c in _silent(grid, sensor, mute[sensor], ended, limits)]
    return silent + [c for c in _shifted(grid, maintenance, (door_on, jammed), mute) if not _echo(c, silent)]


def feigns_wear(case: Case) -> bool:
    """Whether a sensor that has shifted may make the exchanger look worn; one that flatters it hides wear and excuses
    none."""
    check = next(c for c in CHANNELS if c.name == case.facts["channel"])
    by_sensor = check.moves.get(case.facts["sensor"], 0.0) * HX_STEP.moves.get(case.facts["sensor"], 0.0)
    return bool(by_sensor * case.facts["moved"] >= 0.0)


def outlet_doubtful(grid: Grid) -> Array:
    """Flights about which left and right outlet differ as they never did: not an exchanger's doing, whosever it is."""
    gap = np.where(grid.flags("running"), grid.values("w_hx_out_between_packs_k"), np.nan)[:, :, None]
    sd = np.array([c.sd for c in CHANNELS if c.name == "hx_out_between_packs_k"])
    z = watch(gap, sd, np.zeros(gap.shape, dtype=bool), Cusum(learn_flights=5)).z[:, :, 0]
    return persistent(np.abs(z) > 2.5, 2, 3, 10)


def _mute(grid: Grid, limits: Limits) -> dict[str, Array]:
    """Flights on which a sensor that has spoken before is empty too often, or shows one value, by sensor.

    (units, flights) bool
    """
    running, n_snapshots = grid.flags("running"), grid.values("n_snapshots")
    found = {}
    for sensor in SENSORS:
        lost, still = grid.values(f"{sensor}_lost_share"), grid.flags(f"{sensor}_still")
        spoke = np.cumsum(np.nan_to_num(lost, nan=1.0) < 0.5, axis=1) >= 3
        empty = spoke & (lost > limits.lost) & (lost * n_snapshots >= 4)
        found[sensor] = running & (empty | still)
    return found


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


def _shifted(grid: Grid, maintenance: pl.DataFrame, doors: tuple[Array, Array], mute: dict[str, Array]) -> list[Case]:
    """Drifts and steps: a cross check leaves its unit's own level, and its signature says whose sensor did it."""
    door_on, jammed = doors
    running, ended = grid.flags("running"), grid.worked_on(maintenance, ("SENSOR",), REPAIR)
    values = np.stack([np.where(running, grid.values(f"w_{c.name}"), np.nan) for c in CHANNELS], axis=2)
    # what a silent sensor still says is no evidence against others
    for k, check in enumerate(CHANNELS):
        for sensor in (s for s in check.moves if s in mute):
            dumb = mute[sensor] | (grid.across(mute[sensor]) if check.between else False)
            values[dumb, k] = np.nan
    outlet = np.array([c.name in DOOR_MOVES for c in CHANNELS])
    values[(door_on | grid.across(door_on))[:, :, None] & outlet] = np.nan
    values[jammed[:, :, None] & np.array([c.name in BEHIND_DOOR for c in CHANNELS])] = np.nan
    repaired = grid.worked_on(maintenance, ("RAM_DOOR",), REPAIR)
    # what the outlet did just before a door was found faulty was the door's doing
    fresh = repaired | (door_on & ~np.pad(door_on, ((0, 0), (1, 0)))[:, :-1])
    new = ended[:, :, None] | ((fresh | grid.across(fresh))[:, :, None] & outlet)
    for part, checks in NEW_WITH.items():
        renewed = grid.worked_on(maintenance, (part,), REPAIR)
        new = new | (renewed[:, :, None] & np.array([c.name in checks for c in CHANNELS]))
    shift = watch(values, np.array([c.sd for c in CHANNELS]), new)
    evidence = Indications(grid, shift, grid.values("hx_fouling_flight"), grid.partner())
    cases = []
    for channel in range(len(CHANNELS)):
        for unit, first, end in spells(shift.called[:, :, channel], np.zeros_like(ended)):
            named = evidence.name(channel, (unit, first, end))
            if named is not None:
                flight, facts = named
                case = Case(unit, "SENSOR", "SENSOR_FAULT", flight, end, facts | {"since": first, "kind": "shift"})
                cases += [case, *_shared(evidence, case)]
    return _one_each(cases, evidence)


def _shared(evidence: Indications, case: Case) -> list[Case]:
    """The same case of the other pack, where both record one sensor."""
    other = int(evidence.partner[case.unit])
    if case.facts["whose"] != "both" or other < 0:
        return []
    over = case.closed is not None and case.closed < evidence.grid.count(case.unit)
    here = np.array([case.raised, case.facts["since"], case.closed if over else 0])
    raised, since, closed = evidence.same_time(case.unit, here, other).tolist()
    closed = closed if over else None
    if raised < 0 or (closed is not None and closed <= raised):
        return []
    return [replace(case, unit=other, raised=raised, closed=closed, facts=case.facts | {"since": max(since, 0)})]


def _one_each(cases: list[Case], evidence: Indications) -> list[Case]:
    """One case for one fault: several checks may find it, and a left-minus-right one finds it twice.

    Two sensors of a pack hardly ever fail within a few flights: the second name is the first fault's, seen by another
    check. Long after, the other pack may be accused of the same: then the first word was wrong, and its case ends.
    """
    kept: list[Case] = []
    for case in sorted(cases, key=lambda c: (c.raised, -c.facts["p"])):
        sensor, other = case.facts["sensor"], int(evidence.partner[case.unit])
        mine = [c for c in kept if c.unit == case.unit]
        known = [
            c for c in mine if c.facts["sensor"] == sensor and (c.closed is None or case.raised <= c.closed + ECHO)
        ]
        theirs = [c for c in kept if c.unit == other and c.facts["sensor"] == sensor and sensor not in SHARED]
        echoes = [c for c in mine + theirs if case.raised <= c.raised + ECHO]
        if not known and not echoes:
            kept.append(case)
            for wrong in theirs:
                now = max(int(evidence.same_time(case.unit, np.array(case.raised), other)), wrong.raised) + 1
                wrong.closed = now if wrong.closed is None else min(wrong.closed, now)
        elif known and known[0].closed is not None:
            known[0].closed = None if case.closed is None else max(known[0].closed, case.closed)
    return kept
