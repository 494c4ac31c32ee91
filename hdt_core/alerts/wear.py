"""Wear of exchanger and compressor past its limit, the sudden clog, and low margin without wear."""

from collections.abc import Callable

import numpy as np
import polars as pl

from hdt_core.alerts.cases import DIAMETER_SD, FAILS_AT, REPAIR, WEAR_LIMIT, Case, Grid, Limits, fact_after, runs
from hdt_core.components.pack import CC, HX
from hdt_core.health.detection import Cusum, lingering, persistent, since, watch
from hdt_core.records.recoveries import RECOVERY_FLIGHTS
from hdt_core.records.unit_index import NEW_UNIT
from hdt_core.robust import Array
from hdt_core.tracking.sensor_shifts import CORRECTED

SETTLED_FLIGHTS = 5
"""Flights after work on a part before its track counts again."""
FAULT_ECHO = 15
"""Flights after a door or outlet-sensor fault during which its end still looks like a step of the exchanger."""
FAULT_ALLOWANCE = 0.12
"""Loss that a faulty door or outlet sensor (4 K) may feign: beyond it an exchanger is called worn anyway. [-]"""
FEIGNED_FLIGHTS = 90
"""Flights that a faulty sensor may feign a better exchanger before its repair brings the loss back at once."""
BLOCK_FLIGHTS, RISE_MARGIN = 10, 0.03
"""Flights in a block, and by how much the lowest of many blocks lies below a later one by chance: scatter of the ten
0.005, and 0.005 of the model's slow error (`tracking.wear_model.MAP_SD`). [-]"""
DIAMETER_PERSISTENCE = (1, 1, 20)
"""Flights that open and close a case by the diameter, as `cases.Persistence`; its detector has summed many already."""
BEYOND_DOUBT = 0.05
"""Loss beyond its limit at which a worn exchanger that has a case of little margin gets one of wear: two sigma. [-]"""
SAME_CLOG = 40
"""Flights within which a jump and the loss it leads to are one case."""
MARGIN_SETTLED_FLIGHTS = 1
"""Flights of a new or washed unit before its margin counts; the rule needs four of five flights anyway."""


def hx_cases(
    grid: Grid, maintenance: pl.DataFrame, limits: Limits, doubtful: Array, visit_planned: Array
) -> list[Case]:
    """Find fouling past its limit and sudden clogs; `doubtful` (units, flights): a door or the outlet is in doubt.

    Icing has melted by the next flight and never persists. Where a shop visit is planned for little margin already
    (`visit_planned`), a second case of the same exchanger waits until its wear is beyond doubt.
    """
    restart = grid.worked_on(maintenance, ("HX",), HX.ended_by)
    loss = grid.values("hx_fouling")
    sd = grid.values("hx_fouling_sd")
    step = grid.values("hx_fouling_step_3")
    is_settled = (since(restart) > SETTLED_FLIGHTS) & ~(step < -limits.clog)
    reliable = is_settled & (~lingering(doubtful, FAULT_ECHO) | (loss > limits.fouling + FAULT_ALLOWANCE))
    in_doubt = lingering(doubtful, FAULT_ECHO) | grid.has_status("hx_fouling", CORRECTED)
    gain = loss_rise(np.where(in_doubt, np.nan, grid.values("hx_fouling_flight")), restart)
    limit = limits.fouling + np.where(visit_planned, BEYOND_DOUBT, 0.0)
    above_limit = (odds_above(loss, sd, limit) > limits.fouling_odds) | (gain > limit + RISE_MARGIN)
    sure = grid.as_observed(above_limit | _fails_soon(grid, loss, sd, limits), "hx_fouling", restart)
    keep = np.fmax(loss, gain) > limits.fouling_keep * limits.fouling_soon
    is_fouled = persistent(sure & reliable, *limits.wear_persistence, keep=keep, restart=restart)
    may_be_blockage = ~(grid.values("ram_flow_loss_step_3") < limits.ram_flow)
    jump_flags = (step > limits.clog) & ~_returns_after_recovery(step, restart, limits)
    jump_flags &= (np.fmax(loss, gain) > WEAR_LIMIT) & may_be_blockage & reliable & ~_after_repair(grid, maintenance)
    is_clogged = persistent(jump_flags, *limits.clog_persistence, restart=restart)
    clogs = [_extend(run, loss, restart, lambda at: max(0.5 * at, WEAR_LIMIT)) for run in runs(is_clogged, restart)]
    cases = [_hx(grid, "HX_SUDDEN_CLOG", run, gain) for run in clogs]
    for unit, first, end in runs(is_fouled, restart):
        jump = next((c for c in cases if c.unit == unit and _led_to(c, first, restart)), None)
        if jump is None:
            cases.append(_hx(grid, "HX_FOULING", (unit, first, end), gain))
        elif jump.closed_flight is not None:
            jump.closed_flight = None if end is None else max(jump.closed_flight, end)
    return cases


def _extend(
    run: tuple[int, int, int | None], loss: Array, restart: Array, level: Callable[[float], float]
) -> tuple[int, int, int | None]:
    """Let a run last until the loss has been below a level, given that at its start, or until work on the unit."""
    unit, first, end = run
    if end is None:
        return run
    is_lost = ~(loss[unit, first:] < level(loss[unit, first]))
    has_recovered = since(is_lost[None])[0] >= RECOVERY_FLIGHTS
    ends = end + np.flatnonzero(has_recovered[end - first :] | restart[unit, end:])
    return unit, first, int(ends[0]) if ends.size else None


def _led_to(jump: Case, first: int, restart: Array) -> bool:
    """Check whether a loss past its limit since flight `first` is that of a jump before it, on the same unit."""
    return (
        0 <= first - jump.raised_flight <= SAME_CLOG
        and not restart[jump.unit, jump.raised_flight + 1 : first + 1].any()
    )


def _fails_soon(grid: Grid, loss: Array, sd: Array, limits: Limits) -> Array:
    """Flag flights on which a smaller loss grows so fast that waiting for the limit would leave no time to plan.

    Only where the margin is unknown; `low_margin_cases` covers the rest.
    """
    margin_unknown = ~np.isfinite(grid.values("hx_passage_300"))
    slope = 0.5 * sum(grid.values(f"hx_fouling_slope_{n}_per_flight") for n in (30, 100))
    flights_to_failure = (FAILS_AT - loss) / np.maximum(np.nan_to_num(slope), 1e-6)
    return np.asarray(
        margin_unknown
        & (odds_above(loss, sd, limits.fouling_soon) > limits.soon_odds)
        & (flights_to_failure < limits.soon_flights)
    )


def loss_rise(flight_loss: Array, restart: Array) -> Array:
    """Return the median of each flight's own loss over ten flights less the unit's lowest such median.

    The unit's offset drops out, so a track that mistook a passing fault for a new unit does not hide the loss.

    Parameters
    ----------
    flight_loss, restart : array
        (units, flights) each flight's own loss, NaN where unknown or in doubt; flights with a new unit (bool).

    Returns
    -------
    array
        (units, flights); NaN before ten flights of the unit.
    """
    out = np.full(flight_loss.shape, np.nan)
    n_units = flight_loss.shape[0]
    window = np.full((n_units, BLOCK_FLIGHTS), np.nan)
    lowest = np.full(n_units, np.inf)
    for k in range(flight_loss.shape[1]):
        window[restart[:, k]], lowest[restart[:, k]] = np.nan, np.inf
        is_new = np.isfinite(flight_loss[:, k])
        window[is_new] = np.concatenate([window[is_new, 1:], flight_loss[is_new, k, None]], axis=1)
        full = np.isfinite(window).all(axis=1)
        level = np.median(window, axis=1)
        lowest = np.where(full, np.fmin(lowest, level), lowest)
        out[full, k] = (level - lowest)[full]
    return out


def _returns_after_recovery(step: Array, restart: Array, limits: Limits) -> Array:
    """Flag flights after a recovery without work: that loss was feigned, and so is its return."""
    since_recovery = since((step < -0.6 * limits.clog) & ~restart)
    return np.asarray((since_recovery < FEIGNED_FLIGHTS) & (since_recovery < since(restart)))


def _after_repair(grid: Grid, maintenance: pl.DataFrame) -> Array:
    """Flag flights just after work on door or sensors, which ends a feigned recovery."""
    return lingering(grid.worked_on(maintenance, ("RAM_DOOR", "SENSOR"), REPAIR), FAULT_ECHO)


def low_margin_cases(grid: Grid, maintenance: pl.DataFrame, limits: Limits, doubtful: Array) -> list[Case]:
    """Find packs whose message is to be expected within 300 flights though their loss is below its limit.

    On a type with little reserve, or in a hot season, a hardly worn exchanger leaves its level with the ram door full
    open; a new exchanger does not help there. That is reported once for a unit, not each hot week and after each wash:
    again where it has worn since. A case whose loss has grown goes on in cool air. Packs without `hx_passage_300` have
    no case. `doubtful` (units, flights): a door or the outlet is in doubt.
    """
    restart = grid.worked_on(maintenance, ("HX",), HX.ended_by)
    soon = np.nan_to_num(grid.values("hx_passage_300"))
    loss = grid.values("hx_fouling")
    sure = (soon > limits.passage) & (since(restart) > MARGIN_SETTLED_FLIGHTS) & ~doubtful
    sure = grid.as_observed(sure, "hx_fouling", restart)
    low = persistent(
        sure, *limits.margin_persistence, keep=soon > limits.passage_keep * limits.passage, restart=restart
    )
    replaced = grid.worked_on(maintenance, ("HX",), NEW_UNIT)
    cases: list[Case] = []
    last_reported: dict[int, int] = {}
    for run in runs(low, restart):
        unit, start, end = _extend(run, loss, restart, lambda at: at + RISE_MARGIN)
        if loss[unit, start] > limits.fouling:
            continue  # explained by wear, which has its own case
        if cases and cases[-1].unit == unit and not (cases[-1].closed_flight or np.inf) <= start:
            continue  # goes on since the loss has grown
        first = start
        if loss[unit, start] < BEYOND_DOUBT:
            last = last_reported.get(unit)
            last_reported[unit] = start
            if last is not None and not replaced[unit, last + 1 : start + 1].any():
                worn = start + np.flatnonzero(loss[unit, start:end] >= BEYOND_DOUBT)
                if not worn.size:
                    continue
                first = int(worn[0])
        facts = {"since": _last_start(soon[unit, : first + 1] > limits.passage)}
        cases.append(Case(unit, "HX", "HX_LOW_MARGIN", first, end, facts))
    return cases


def cc_cases(grid: Grid, maintenance: pl.DataFrame, limits: Limits, doubtful: Array) -> list[Case]:
    """Find compressor wear: by efficiency where it is known, else by effective diameter since the unit's start.

    `doubtful` (units, flights): a sensor of the pack is at fault.
    """
    restart = grid.worked_on(maintenance, ("CC",), CC.ended_by)
    loss = grid.values("cc_efficiency_loss")
    sd = grid.values("cc_efficiency_loss_sd")
    sure = (
        (odds_above(loss, sd, limits.compressor) > limits.compressor_odds)
        & (loss > limits.compressor_excess * limits.compressor)
        & (since(restart) > SETTLED_FLIGHTS)
    )
    sure = grid.as_observed(sure, "cc_efficiency_loss", restart)
    by_efficiency = persistent(
        sure, *limits.compressor_persistence, keep=loss > limits.compressor_keep * limits.compressor, restart=restart
    )
    # equation (5) takes the root of efficiency
    diameter = _diameter(grid, restart, 0.5 * limits.compressor)
    has_efficiency = np.logical_or.accumulate(np.isfinite(loss), axis=1)
    by_diameter = persistent(
        (diameter[:, :, 1] > 0.5) & ~has_efficiency & ~doubtful,
        *DIAMETER_PERSISTENCE,
        keep=(diameter[:, :, 0] < -limits.compressor_keep * 0.5 * limits.compressor) & ~has_efficiency,
        restart=restart,
    )
    cases = []
    for unit, first, end in runs(by_efficiency | by_diameter, restart):
        shrinkage = fact_after("shrunk", diameter[unit, :, 0])
        cases.append(Case(unit, "CC", "CC_DEGRADED", first, end, {"since": first}, shrinkage))
    return cases


def _hx(grid: Grid, diagnosis: str, run: tuple[int, int, int | None], gain: Array) -> Case:
    """Return a case of an exchanger with its facts; `gain` (units, flights): of `loss_rise`."""
    unit, first, end = run
    jump = float(grid.track("hx_fouling_step_3", unit)[first])
    facts = {"since": _last_start(grid.track("hx_fouling", unit)[: first + 1] > WEAR_LIMIT), "jump": jump}
    return Case(unit, "HX", diagnosis, first, end, facts, fact_after("gained", gain[unit]))


def _last_start(flags: Array) -> int:
    """Return the flight from which on all are flagged. (flights,)"""
    return int(np.flatnonzero(np.append(True, ~flags))[-1])


def _diameter(grid: Grid, restart: Array, limit: float) -> Array:
    """Return the change of ln diameter since the start, and whether its loss exceeds `limit`. (units, flights, 2)"""
    diameter = np.where(grid.flags("running"), grid.values("cc_effective_diameter_m"), np.nan)
    settings = Cusum(slack=0.75, clear=1.0, learn_flights=20, memory_flights=10**6)
    shift = watch(np.log(diameter)[:, :, None], np.array([DIAMETER_SD]), restart[:, :, None], settings)
    smaller = shift.alarm & (shift.sum_low > shift.sum_high) & (shift.departure < -limit)
    return np.concatenate([shift.departure, smaller.astype(float)], axis=2)


def odds_above(value: Array, sd: Array, limit: Array | float) -> Array:
    """Return the probability that the quantity exceeds the limit; 0 where unknown."""
    from scipy.special import ndtr  # noqa: PLC0415 (loads for a fifth of a second, which an idle night saves)

    safe = np.maximum(np.nan_to_num(sd, nan=1.0), 1e-6)
    return np.asarray(np.nan_to_num(ndtr((value - limit) / safe)))
