"""Ram door faults by the controller's law: a jam, and travel that ends too soon."""

import numpy as np
import polars as pl

from hdt_core.alerts.cases import REPAIR, Case, Limits, runs
from hdt_core.alerts.grid import Grid
from hdt_core.flight.control_schedules import DOOR_FREE
from hdt_core.health.detection import persistent
from hdt_core.records.keys import PACK
from hdt_core.robust import Array

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
    jam, peg = _jams(grid, limits), _pegs(grid, limits)
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
                hits, stop = [], None
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
