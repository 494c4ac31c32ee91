"""Wear of exchanger and compressor past its limit, and the sudden clog."""

from collections.abc import Callable
from typing import Any

import numpy as np
import polars as pl
from scipy.special import ndtr

from hdt_core.alerts.cases import DIAMETER_SD, FAILS_AT, REPAIR, Case, Limits, spells
from hdt_core.alerts.grid import Grid
from hdt_core.health.detection import Array, Cusum, lingering, persistent, since, watch

SETTLED = 5
"""Flights after work on a part before its track is believed again."""
FAULT_ECHO = 15
"""Flights after a door or outlet-sensor fault during which its end still looks like a step of the exchanger."""
FAULT_ALLOWANCE = 0.12
"""Loss that a faulty door or outlet sensor (4 K) may feign: beyond it an exchanger is called worn all the same."""
FEIGNED = 90
"""Flights that a faulty sensor may feign a better exchanger before its repair brings the loss back at once."""
TEN, RISE_MARGIN = 10, 0.03
"""Flights taken together, and what the lowest of many tens lies below a later one by chance alone: scatter of the ten
0.005, and 0.005 of the model's slow error (`tracking.wear_model.MAP_SD`). [-]"""
BEYOND_DOUBT = 0.05
"""Loss beyond its limit at which a worn exchanger that has a case of little margin gets one of wear: two sigma. [-]"""
SAME_CLOG = 40
"""Flights within which a jump and the loss it leads to are one case."""
SHRUNK = 0.025
"""Loss of effective diameter that an efficiency loss of 5 % brings: equation (5) takes the root of efficiency."""


def hx_cases(
    grid: Grid, maintenance: pl.DataFrame, limits: Limits, sick: Array, planned: Array | None = None
) -> list[Case]:
    """Fouling past its limit, and sudden clogs; `sick` (units, flights) tells where a door or the outlet is in doubt.

    Icing is gone by the next flight and never persists. Where a shop visit is `planned` for little margin already, a
    second case of the same exchanger waits until its wear is beyond doubt.
    """
    ended = grid.worked_on(maintenance, ("HX",), ("REPLACED", "CLEANED"))
    loss, sd, step = grid.values("hx_fouling"), grid.values("hx_fouling_sd"), grid.values("hx_fouling_step_3")
    settled = (since(ended) > SETTLED) & ~(step < -limits.clog)
    trusted = settled & (~lingering(sick, FAULT_ECHO) | (loss > limits.fouling + FAULT_ALLOWANCE))
    gained = risen(np.where(lingering(sick, FAULT_ECHO), np.nan, grid.values("hx_fouling_flight")), ended)
    limit = limits.fouling + (0.0 if planned is None else np.where(planned, BEYOND_DOUBT, 0.0))
    worn = (odds_above(loss, sd, limit) > limits.fouling_odds) | (gained > limit + RISE_MARGIN)
    sure = grid.as_observed(worn | _soon(grid, loss, sd, limits), "hx_fouling", ended)
    keep = np.fmax(loss, gained) > 0.75 * limits.fouling_soon
    # what was gained stays known after the last flight, where a busier pack still has columns
    fouled = persistent(sure & trusted & grid.flown, 3, 4, 15, keep=keep, ended=ended)
    blocked = ~(grid.values("ram_flow_loss_step_3") < limits.ram_flow)
    jumped = (step > limits.clog) & (np.fmax(loss, gained) > 0.05) & ~_back_again(step, ended, limits)
    clogged = persistent(jumped & blocked & trusted & ~_repaired(grid, maintenance), 1, 1, 30, ended=ended)
    cases = [_hx(grid, "HX_SUDDEN_CLOG", spell, gained) for spell in spells(clogged, ended)]
    for unit, first, end in spells(fouled, ended):
        jump = next((c for c in cases if c.unit == unit and _led_to(c, first, ended)), None)
        if jump is None:
            cases.append(_hx(grid, "HX_FOULING", (unit, first, end), gained))
        elif jump.closed is not None:
            jump.closed = None if end is None else max(jump.closed, end)
    return cases


def _led_to(jump: Case, first: int, ended: Array) -> bool:
    """Whether a loss past its limit since flight `first` is that of a jump before it, on the same unit."""
    return 0 <= first - jump.raised <= SAME_CLOG and not ended[jump.unit, jump.raised + 1 : first + 1].any()


def _soon(grid: Grid, loss: Array, sd: Array, limits: Limits) -> Array:
    """Flights on which a smaller loss grows so fast that waiting for the limit would leave a planner no time.

    Where the margin is known, it says so itself: see `low_margin`.
    """
    unknown = ~np.isfinite(grid.values("hx_passage_300"))
    slope = 0.5 * sum(grid.values(f"hx_fouling_slope_{n}_per_flight") for n in (30, 100))
    left = (FAILS_AT - loss) / np.maximum(np.nan_to_num(slope), 1e-6)
    return np.asarray(
        unknown & (odds_above(loss, sd, limits.fouling_soon) > limits.soon_odds) & (left < limits.soon_flights)
    )


def risen(alone: Array, ended: Array) -> Array:
    """How far each flight's own estimates, ten together, lie above the lowest ten of the unit: no more than its loss.

    The unit's offset drops out, so that a track which mistook a passing fault for a new unit is no excuse.

    Parameters
    ----------
    alone, ended : array
        (units, flights) loss as each flight alone says, NaN where unknown or in doubt; flights with a new unit (bool).

    Returns
    -------
    array
        (units, flights); NaN before ten flights of the unit.
    """
    out, window, lowest = (
        np.full(alone.shape, np.nan),
        np.full((alone.shape[0], TEN), np.nan),
        np.full(alone.shape[0], np.inf),
    )
    for k in range(alone.shape[1]):
        window[ended[:, k]], lowest[ended[:, k]] = np.nan, np.inf
        seen = np.isfinite(alone[:, k])
        window[seen] = np.concatenate([window[seen, 1:], alone[seen, k, None]], axis=1)
        full = np.isfinite(window).all(axis=1)
        level = np.median(window, axis=1)
        lowest = np.where(full, np.fmin(lowest, level), lowest)
        out[full, k] = (level - lowest)[full]
    return out


def _back_again(step: Array, ended: Array, limits: Limits) -> Array:
    """Flights after an unexplained recovery: what falls without work was feigned, and so is its return."""
    fell = since((step < -0.6 * limits.clog) & ~ended)
    return np.asarray((fell < FEIGNED) & (fell < since(ended)))


def _repaired(grid: Grid, maintenance: pl.DataFrame) -> Array:
    """Flights just after work on door or sensors, which ends what a faulty one had feigned."""
    return lingering(grid.worked_on(maintenance, ("RAM_DOOR", "SENSOR"), REPAIR), FAULT_ECHO)


def cc_cases(grid: Grid, maintenance: pl.DataFrame, limits: Limits, doubtful: Array) -> list[Case]:
    """Compressor wear: by efficiency where it is known, else by effective diameter against the unit's own start."""
    ended = grid.worked_on(maintenance, ("CC",), ("REPLACED",))
    loss, sd = grid.values("cc_efficiency_loss"), grid.values("cc_efficiency_loss_sd")
    sure = (odds_above(loss, sd, limits.compressor) > 0.9) & (loss > 1.2 * limits.compressor) & (since(ended) > SETTLED)
    sure = grid.as_observed(sure, "cc_efficiency_loss", ended)
    by_efficiency = persistent(sure, 4, 5, 20, keep=loss > 0.7 * limits.compressor, ended=ended)
    shrunk = _diameter(grid, ended)
    by_diameter = (shrunk[:, :, 1] > 0.5) & ~_ever(np.isfinite(loss)) & ~doubtful
    cases = []
    for u, a, b in spells(by_efficiency | by_diameter, ended):
        cases.append(Case(u, "CC", "CC_DEGRADED", a, b, {"since": a}, _reader("shrunk", shrunk[u, :, 0])))
    return cases


def _hx(grid: Grid, diagnosis: str, spell: tuple[int, int, int | None], gained: Array) -> Case:
    unit, first, end = spell
    small = np.nonzero(~(grid.track("hx_fouling", unit)[: first + 1] > 0.05))[0]
    facts = {
        "since": int(small[-1]) + 1 if small.size else 0,
        "jump": float(grid.track("hx_fouling_step_3", unit)[first]),
    }
    return Case(unit, "HX", diagnosis, first, end, facts, _reader("gained", gained[unit]))


def _reader(name: str, values: Array) -> Callable[[int], dict[str, Any]]:
    """Gives a case's own measure after any flight. `values` (flights,)."""
    return lambda flight: {name: float(values[flight])}


def _diameter(grid: Grid, ended: Array) -> Array:
    """Relative change of the effective diameter since the unit's first flights, and whether it is believed smaller."""
    diameter = np.where(grid.flags("running"), grid.values("cc_effective_diameter_m"), np.nan)
    settings = Cusum(slack=0.75, clear=1.0, learn_flights=20, memory_flights=10**6)
    shift = watch(np.log(diameter)[:, :, None], np.array([DIAMETER_SD]), ended[:, :, None], settings)
    smaller = shift.called & (shift.sum_low > shift.sum_high) & (shift.moved < -SHRUNK)
    return np.concatenate([shift.moved, smaller.astype(float)], axis=2)


def odds_above(value: Array, sd: Array, limit: Array | float) -> Array:
    """Probability that the quantity is above the limit; 0 where unknown."""
    safe = np.maximum(np.nan_to_num(sd, nan=1.0), 1e-6)
    return np.asarray(np.nan_to_num(ndtr((value - limit) / safe)))


def _ever(flags: Array) -> Array:
    """Whether a flag was true on this flight or before."""
    return np.asarray(np.logical_or.accumulate(flags, axis=1))
