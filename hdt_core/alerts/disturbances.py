"""Disturbances: faults of doors by their controller's law, faults of sensors, and where both cast doubt on wear."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from hdt_core.alerts.cases import REPAIR, Case, Grid, Limits, open_flights, runs
from hdt_core.alerts.fault_isolation import CHANNELS, HX_STEP, Indications
from hdt_core.flight.control_schedules import DOOR_FREE
from hdt_core.flight.quality import SHARED_SENSORS
from hdt_core.health.detection import Cusum, persistent, watch
from hdt_core.records.keys import PACK
from hdt_core.robust import Array
from hdt_core.tables.raw import SIGNALS

STOP_MEMORY = 40
"""Flights within which two hits of the same opening confirm a stop."""
SAME_STOP = 0.03
"""Openings closer than this may be one stop: noise, quantisation and a flight's last approach to it. [-]"""
JAM_ABOVE, PEG_ABOVE = 0.06, 0.15
"""A door no wider than this above its lower stop may rest there; its outlet is then no evidence of its travel. [-]"""
SURE_PEG_K, SURE_PEG_SAMPLES = 3.0, 3
"""Excess and samples at the stop with which one flight is enough: nine sigma of a sound flight, and more
than a TAT error of 5 K feigns. [K]"""
WARM_K, USUAL_FLIGHTS = 6.0, 40
"""Outlet above what is usual beside its target at which a motionless door is jammed wherever it stands, for a free one
would open: three sigma of a flight's own trim, [K]; and the flights whose median is the usual value."""
MOTION_SAMPLES, PEG_SAMPLES, OFF_PEG_SAMPLES = 8, 2, 3
"""Samples of a flight from which a door's travel is judged, and its outlet at its widest opening and below it."""
WIDE_OPEN = 0.93
"""Opening above which a door is at its proper end, as behind a fouled exchanger. [-]"""


def door_cases(grid: Grid, maintenance: pl.DataFrame, limits: Limits) -> list[Case]:
    """Find jams and losses of travel of all doors.

    On a jam the door stays from climb to descent while its sensor still shows noise (a frozen sensor shows none), away
    from its stops, or anywhere if the outlet runs warm. On a loss of travel the outlet ran warm at the widest opening,
    and on target below it, on one flight beyond doubt or on two at the same opening.
    """
    restart = grid.worked_on(maintenance, ("RAM_DOOR",), REPAIR)
    jam = _jams(grid, limits)
    peg = _pegs(grid, limits)
    is_jammed = persistent(jam, *limits.jam_persistence, restart=restart)
    sure = peg & (grid.values("door_peg_excess_k") > SURE_PEG_K) & (grid.values("door_peg_n") >= SURE_PEG_SAMPLES)
    short_travel = _same_stop(grid.values("door_max"), peg & ~jam, sure & ~jam, restart) & ~is_jammed
    cases = [_case(grid, "jam", jam, run) for run in runs(is_jammed, restart)]
    return cases + [_case(grid, "lost travel", peg, run) for run in runs(short_travel, restart)]


def _jams(grid: Grid, limits: Limits) -> Array:
    """Flag flights on which the door does not move, though it is away from its stops or the outlet runs warm."""
    widest = grid.values("door_max")
    away = (widest > np.fmax(DOOR_FREE[0], _lower_stop(grid) + JAM_ABOVE)) & (widest < DOOR_FREE[1])
    motionless = (grid.values("door_span") < limits.still_span) & (grid.values("door_n") >= MOTION_SAMPLES)
    warm = (_above_usual_k(grid) > WARM_K) & (widest < DOOR_FREE[1])
    return grid.flags("running") & (away | warm) & motionless & ~grid.flags("ram_door_open_still")


def _above_usual_k(grid: Grid) -> Array:
    """Return the outlet above its target less the median over the flights before. (units, flights) [K]"""
    out = np.full(grid.shape, np.nan)
    if "w_hx_out_minus_target_k" in grid.rows.columns:
        above = pl.col("w_hx_out_minus_target_k")
        usual = above.shift(1).rolling_median(USUAL_FLIGHTS, min_samples=5).over(PACK)
        out[grid.unit, grid.flight] = grid.rows.select(above - usual)[:, 0].cast(pl.Float64).to_numpy()
    return out


def _pegs(grid: Grid, limits: Limits) -> Array:
    """Flag flights on which the outlet ran warm at the widest opening, which is not the full one."""
    enough = (grid.values("door_peg_n") >= PEG_SAMPLES) & (grid.values("door_off_peg_n") >= OFF_PEG_SAMPLES)
    widest = grid.values("door_max")
    partly = (widest < WIDE_OPEN) & (widest > _lower_stop(grid) + PEG_ABOVE)
    return grid.flags("running") & enough & partly & (grid.values("door_peg_excess_k") > limits.peg_k)


def _lower_stop(grid: Grid) -> Array:
    """Return the smallest opening of either pack's door so far; types differ in where their doors rest."""
    low = grid.values("door_max") - grid.values("door_span")
    return np.asarray(np.fmin.accumulate(np.fmin(low, grid.across(low)), axis=1))


def _same_stop(widest: Array, peg: Array, sure: Array, restart: Array) -> Array:
    """Flag flights with a stop: from its second hit or first sure one until the door is repaired or opens wider."""
    out = np.zeros(peg.shape, dtype=bool)
    for unit in np.nonzero(peg.any(axis=1))[0]:
        hits: list[tuple[int, float]] = []
        stop: float | None = None
        for k in range(peg.shape[1]):
            if restart[unit, k] or (stop is not None and widest[unit, k] > stop + 2.0 * SAME_STOP):
                hits = []
                stop = None
            if peg[unit, k]:
                opening = float(widest[unit, k])
                hits = [hit for hit in hits if k - hit[0] <= STOP_MEMORY]
                is_repeat = any(abs(hit[1] - opening) < SAME_STOP for hit in hits)
                stop = opening if is_repeat or sure[unit, k] else stop
                hits.append((k, opening))
            out[unit, k] = stop is not None
    return out


def _case(grid: Grid, kind: str, flags: Array, run: tuple[int, int, int | None]) -> Case:
    unit, first, end = run
    window = slice(max(first - STOP_MEMORY, 0), first + 1)
    hits = np.nonzero(flags[unit, window])[0]
    excess_k = grid.values("door_peg_excess_k")[unit, window][hits]
    facts = {
        "kind": kind,
        "since": int(hits[0]) + window.start if hits.size else first,
        "stop": float(np.median(grid.values("door_max")[unit, window][hits])) if hits.size else np.nan,
        "excess_k": float(np.nanmax(np.append(excess_k, 0.0))),
    }
    return Case(unit, "RAM_DOOR", "RAM_DOOR_FAULT", first, end, facts)


OUTLET_CHECKS = ("hx_out_minus_target_k", "hx_out_between_packs_k")
"""Checks that a faulty door of either pack shifts as well as a faulty sensor."""
BEHIND_DOOR = ("hx_in_over_discharge_k", "hx_in_over_pressure_k", "conductance_off_cruise_ln")
"""Checks whose laws do not cover the openings of a jammed door."""
NEW_WITH = {"HX": BEHIND_DOOR, "CC": ("hx_in_over_discharge_k", "hx_in_over_pressure_k")}
"""Checks whose level changes when a part is replaced or washed: its ram side, its efficiency (by up to 1.9 K)."""
OUTLET_JUMP_SIGMA, OUTLET_JUMP_PERSISTENCE = 2.5, (2, 3, 10)
"""Jump of the outlets' difference that puts both in doubt [sigma], on how many of how many flights, for how long."""
LEAST_USABLE_FLIGHTS, LEAST_EMPTY_READINGS = 3, 4
"""Flights on which a sensor was usable before it can fail, and empty readings that make a flight count as lost."""
ECHO_FLIGHTS = 12
"""Flights before and after a case within which another of the same sensor is the same fault."""


def sensor_cases(
    grid: Grid, maintenance: pl.DataFrame, limits: Limits, door_faulty: Array, door_stuck: Array
) -> list[Case]:
    """Find the cases of all sensors; `door_faulty`, `door_stuck` (units, flights): the door has a fault, or a jam."""
    restart = grid.worked_on(maintenance, ("SENSOR",), REPAIR)
    unusable = _unusable(grid, limits)
    dropouts = [c for sensor in SIGNALS for c in _dropout_cases(grid, sensor, unusable[sensor], restart, limits)]
    shifts = _shift_cases(grid, maintenance, (door_faulty, door_stuck), unusable)
    return dropouts + [case for case in shifts if not _repeats(case, dropouts)]


def may_feign_wear(case: Case) -> bool:
    """Check whether a biased sensor may make the exchanger look worn; a bias of the other sign hides wear."""
    check = next(c for c in CHANNELS if c.name == case.facts["channel"])
    by_sensor = check.effects.get(case.facts["sensor"], 0.0) * HX_STEP.effects.get(case.facts["sensor"], 0.0)
    return bool(by_sensor * case.facts["moved"] >= 0.0)


def outlet_doubtful(grid: Grid) -> Array:
    """Flag flights about which the difference of left and right outlet jumps, which no exchanger does."""
    gap = np.where(grid.flags("running"), grid.values("w_hx_out_between_packs_k"), np.nan)[:, :, None]
    sd = np.array([c.sd for c in CHANNELS if c.name == "hx_out_between_packs_k"])
    z = watch(gap, sd, np.zeros(gap.shape, dtype=bool), Cusum(learn_flights=5)).z[:, :, 0]
    return persistent(np.abs(z) > OUTLET_JUMP_SIGMA, *OUTLET_JUMP_PERSISTENCE)


def _unusable(grid: Grid, limits: Limits) -> dict[str, Array]:
    """Flag, by sensor, flights on which a once usable sensor is empty too often or frozen. (units, flights) bool"""
    running = grid.flags("running")
    n_snapshots = grid.values("n_snapshots")
    unusable = {}
    for sensor in SIGNALS:
        lost_share = grid.values(f"{sensor}_lost_share")
        still = grid.flags(f"{sensor}_still")
        usable_before = np.cumsum(np.nan_to_num(lost_share, nan=1.0) < 0.5, axis=1) >= LEAST_USABLE_FLIGHTS
        empty = usable_before & (lost_share > limits.lost_share) & (lost_share * n_snapshots >= LEAST_EMPTY_READINGS)
        unusable[sensor] = running & (empty | still)
    return unusable


def _dropout_cases(grid: Grid, sensor: str, unusable: Array, restart: Array, limits: Limits) -> Iterator[Case]:
    """Yield the cases of a sensor that is frozen or empty in many of its readings."""
    lost_share = grid.values(f"{sensor}_lost_share")
    still = grid.flags(f"{sensor}_still")
    of_other_pack = grid.across(unusable)
    keep = lost_share > limits.lost_share / 3.0
    active = persistent(unusable, *limits.dropout_persistence, keep=keep, restart=restart)
    for unit, first, end in runs(active, restart):
        kind = "frozen" if still[unit, first] or lost_share[unit, first] > 0.95 else "dropout"
        facts = {
            "sensor": sensor, "kind": kind, "since": max(first - 1, 0), "share": float(lost_share[unit, first]),
            "whose": "both" if of_other_pack[unit, first] else "own",
        }  # fmt: skip
        yield Case(unit, "SENSOR", "SENSOR_FAULT", first, end, facts)


def _repeats(case: Case, dropouts: list[Case]) -> bool:
    """Check whether a shift is that of a sensor already reported as dropped out or frozen."""
    same = [s for s in dropouts if s.unit == case.unit and s.facts["sensor"] == case.facts["sensor"]]
    return any(
        s.raised_flight - ECHO_FLIGHTS <= case.raised_flight
        and (s.closed_flight is None or case.raised_flight <= s.closed_flight + ECHO_FLIGHTS)
        for s in same
    )


def _shift_cases(
    grid: Grid, maintenance: pl.DataFrame, doors: tuple[Array, Array], unusable: dict[str, Array]
) -> list[Case]:
    """Find drifts and steps: a cross check leaves its unit's own level, and the signatures isolate the sensor."""
    door_faulty, door_stuck = doors
    running = grid.flags("running")
    restart = grid.worked_on(maintenance, ("SENSOR",), REPAIR)
    values = np.stack([np.where(running, grid.values(f"w_{c.name}"), np.nan) for c in CHANNELS], axis=2)
    # the remaining values of an unusable sensor are no evidence against others
    for k, check in enumerate(CHANNELS):
        for sensor in (s for s in check.effects if s in unusable):
            bad = unusable[sensor] | (grid.across(unusable[sensor]) if check.between else False)
            values[bad, k] = np.nan
    outlet = np.array([c.name in OUTLET_CHECKS for c in CHANNELS])
    values[(door_faulty | grid.across(door_faulty))[:, :, None] & outlet] = np.nan
    values[door_stuck[:, :, None] & np.array([c.name in BEHIND_DOOR for c in CHANNELS])] = np.nan
    door_repair = grid.worked_on(maintenance, ("RAM_DOOR",), REPAIR)
    # a shift of the outlet just before a door fault is detected is the door's
    fresh = door_repair | (door_faulty & ~np.pad(door_faulty, ((0, 0), (1, 0)))[:, :-1])
    new = restart[:, :, None] | ((fresh | grid.across(fresh))[:, :, None] & outlet)
    with_part = np.zeros_like(new)
    for part, checks in NEW_WITH.items():
        part_repair = grid.worked_on(maintenance, (part,), REPAIR)
        with_part |= part_repair[:, :, None] & np.array([c.name in checks for c in CHANNELS])
    sds = np.array([c.sd for c in CHANNELS])
    shift = watch(values, sds, new | with_part)
    # work on a part repairs no sensor: a shift that has begun goes on against the level before it
    has_begun = np.pad(shift.alarm, ((0, 0), (1, 0), (0, 0)))[:, :-1]
    if (has_begun & with_part).any():
        shift = watch(values, sds, new | (with_part & ~has_begun))
    evidence = Indications(grid, shift, grid.values("hx_fouling_flight"), grid.partner())
    cases = []
    for channel in range(len(CHANNELS)):
        for unit, first, end in runs(shift.alarm[:, :, channel], np.zeros_like(restart)):
            if (isolation := evidence.isolate(channel, (unit, first, end))) is not None:
                flight, facts = isolation
                case = Case(unit, "SENSOR", "SENSOR_FAULT", flight, end, facts | {"since": first, "kind": "shift"})
                cases += [case, *_shared_case(evidence, case)]
    return _merge_cases(cases, evidence)


def _shared_case(evidence: Indications, case: Case) -> list[Case]:
    """Return the same case of the other pack, where both record one sensor or changed at once."""
    other = int(evidence.partner[case.unit])
    if case.facts["whose"] != "both" or other < 0:
        return []
    is_over = case.closed_flight is not None and case.closed_flight < evidence.grid.count(case.unit)
    flights = np.array([case.raised_flight, case.facts["since"], case.closed_flight if is_over else 0])
    raised_flight, since, closed_flight = evidence.same_time(case.unit, flights, other).tolist()
    closed_flight = closed_flight if is_over else None
    if raised_flight < 0 or (closed_flight is not None and closed_flight <= raised_flight):
        return []
    facts = case.facts | {"since": max(since, 0)}
    return [replace(case, unit=other, raised_flight=raised_flight, closed_flight=closed_flight, facts=facts)]


def _merge_cases(cases: list[Case], evidence: Indications) -> list[Case]:
    """Merge the cases of one fault: several checks may detect it, and a left-minus-right one detects it twice.

    Two sensors of a pack hardly ever fail within a few flights: the second isolation is the first fault in another
    check. Where the other pack's same sensor is isolated much later, the first isolation was wrong and its case ends.
    """
    distinct: list[Case] = []
    for case in sorted(cases, key=lambda c: (c.raised_flight, -c.facts["p"])):
        sensor = case.facts["sensor"]
        other = int(evidence.partner[case.unit])
        on_pack = [c for c in distinct if c.unit == case.unit]
        same = [
            c
            for c in on_pack
            if c.facts["sensor"] == sensor
            and (c.closed_flight is None or case.raised_flight <= c.closed_flight + ECHO_FLIGHTS)
        ]
        on_other_pack = [
            c for c in distinct if c.unit == other and c.facts["sensor"] == sensor and not _are_of_both_packs(c, case)
        ]
        echoes = [c for c in on_pack + on_other_pack if case.raised_flight <= c.raised_flight + ECHO_FLIGHTS]
        if not same and not echoes:
            distinct.append(case)
            for wrong in on_other_pack:
                now = int(evidence.same_time(case.unit, np.array(case.raised_flight), other))
                last = max(now, wrong.raised_flight) + 1
                wrong.closed_flight = last if wrong.closed_flight is None else min(wrong.closed_flight, last)
        elif same and same[0].closed_flight is not None:
            end = case.closed_flight
            same[0].closed_flight = None if end is None else max(same[0].closed_flight, end)
    return distinct


def _are_of_both_packs(*cases: Case) -> bool:
    """Return whether the cases are those of one fault that both packs show."""
    return all(c.facts["whose"] == "both" or c.facts["sensor"] in SHARED_SENSORS for c in cases)


@dataclass(frozen=True, slots=True)
class Disturbances:
    """Cases of doors and sensors, and where they cast doubt on wear. Flags are (units, flights) bool.

    `sensor_faulty`: a sensor case is open. `outlet_doubtful`: the outlet temperature is unreliable. `wear_feigned`: a
    biased sensor may look like wear. `wear_doubtful`: either, or any biased sensor.
    """

    cases: list[Case]
    sensor_faulty: Array
    outlet_doubtful: Array
    wear_feigned: Array
    wear_doubtful: Array


def find_disturbances(grid: Grid, maintenance: pl.DataFrame, limits: Limits) -> Disturbances:
    """Find door and sensor cases, and the flights on which they cast doubt on wear."""
    doors = door_cases(grid, maintenance, limits)
    door_faulty = open_flights(grid.shape, doors)
    door_stuck = open_flights(grid.shape, [c for c in doors if c.facts["kind"] == "jam"])
    sensors = sensor_cases(grid, maintenance, limits, door_faulty, door_stuck)
    biases = [c for c in sensors if c.facts.get("biased")]
    # outlets that differ cast no doubt once a sensor or door explains the difference
    is_explained = door_faulty | open_flights(grid.shape, [c for c in biases if c.facts["sensor"] == "hx_out_k"])
    doubtful = door_faulty | (outlet_doubtful(grid) & ~is_explained & ~grid.across(is_explained))
    return Disturbances(
        cases=doors + sensors,
        sensor_faulty=open_flights(grid.shape, sensors),
        outlet_doubtful=doubtful,
        wear_feigned=open_flights(grid.shape, [c for c in biases if may_feign_wear(c)]),
        wear_doubtful=doubtful | open_flights(grid.shape, biases),
    )
