"""Ram door faults, told by the controller's law: a jam, and travel that ends too soon."""

import numpy as np
import polars as pl

from hdt_core.health.controller import DOOR_FREE
from hdt_core.health.detection import Array, persistent
from hdt_core.health.episodes import REPAIR, Case, Limits, spells
from hdt_core.health.grid import Grid

STOP_MEMORY = 40
"""Flights within which a door that ran into the same stop twice is believed to have one."""
SAME_STOP = 0.03
"""Openings closer than this may be one stop: noise, quantisation and a flight's last approach to it. [-]"""
JAM_ABOVE, PEG_ABOVE = 0.06, 0.15
"""A door no wider than this above its lower stop may rest there, and its outlet then says nothing of its travel. [-]"""
WIDE_OPEN = 0.93
"""A door that rests wider than this is at its proper end: a fouled exchanger's, not a faulty door's."""


def door_cases(grid: Grid, maintenance: pl.DataFrame, limits: Limits) -> list[Case]:
    """Cases of all doors.

    A jam: the door stays from climb to descent while its sensor still shows noise (a frozen sensor shows none). Lost
    travel: on two flights the outlet ran warm at the same widest opening, and on target below it.
    """
    ended = grid.worked_on(maintenance, ("RAM_DOOR",), REPAIR)
    jam, peg = _jams(grid, limits), _pegs(grid, limits)
    jammed = persistent(jam, 2, 3, 4, ended=ended)
    stopped = _same_stop(grid.values("door_max"), peg & ~jam, ended) & ~jammed
    cases = [_case(grid, "jam", jam, spell) for spell in spells(jammed, ended)]
    return cases + [_case(grid, "lost travel", peg, spell) for spell in spells(stopped, ended)]


def _jams(grid: Grid, limits: Limits) -> Array:
    widest = grid.values("door_max")
    away = (widest > np.fmax(DOOR_FREE[0], _lower_stop(grid) + JAM_ABOVE)) & (widest < DOOR_FREE[1])
    motionless = (grid.values("door_span") < limits.still_span) & (grid.values("door_n") >= 8)
    return grid.flags("running") & away & motionless & ~grid.flags("ram_door_open_still")


def _pegs(grid: Grid, limits: Limits) -> Array:
    enough = (grid.values("door_peg_n") >= 2) & (grid.values("door_off_peg_n") >= 3)
    widest = grid.values("door_max")
    partly = (widest < WIDE_OPEN) & (widest > _lower_stop(grid) + PEG_ABOVE)
    return grid.flags("running") & enough & partly & (grid.values("door_peg_excess_k") > limits.peg_k)


def _lower_stop(grid: Grid) -> Array:
    """Smallest opening that either pack's door has shown so far; types differ in where their doors come to rest."""
    low = grid.values("door_max") - grid.values("door_span")
    return np.asarray(np.fmin.accumulate(np.fmin(low, grid.across(low)), axis=1))


def _same_stop(widest: Array, peg: Array, ended: Array) -> Array:
    """Flights on which a stop is believed: from the second time it was hit until the door is repaired or goes wider."""
    out = np.zeros(peg.shape, dtype=bool)
    for unit in np.nonzero(peg.any(axis=1))[0]:
        stops: list[tuple[int, float]] = []
        believed: float | None = None
        for k in range(peg.shape[1]):
            if ended[unit, k]:
                stops, believed = [], None
            if believed is not None and widest[unit, k] > believed + 2.0 * SAME_STOP:
                stops, believed = [], None
            if peg[unit, k]:
                here = float(widest[unit, k])
                stops = [s for s in stops if k - s[0] <= STOP_MEMORY]
                believed = here if any(abs(s[1] - here) < SAME_STOP for s in stops) else believed
                stops.append((k, here))
            out[unit, k] = believed is not None
    return out


def _case(grid: Grid, kind: str, seen: Array, spell: tuple[int, int, int | None]) -> Case:
    unit, first, end = spell
    window = slice(max(first - STOP_MEMORY, 0), first + 1)
    hits = np.nonzero(seen[unit, window])[0]
    excess_k = grid.values("door_peg_excess_k")[unit, window][hits]
    facts = {
        "kind": kind,
        "since": int(hits[0]) + window.start if hits.size else first,
        "stop": float(np.median(grid.values("door_max")[unit, window][hits])) if hits.size else np.nan,
        "excess_k": float(np.nanmax(np.append(excess_k, 0.0))),
    }
    return Case(unit, "RAM_DOOR", "RAM_DOOR_FAULT", first, end, facts)
