"""Filter a declared component's health along its flights, each estimated by `calibration.component_fit`."""

from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.calibration.baseline_wear import ENTRY, MIN_FLIGHT_SD, EntryWear
from hdt_core.calibration.component_fit import WITHOUT_ESTIMATE
from hdt_core.components import Component
from hdt_core.components.declaration import CLEANED
from hdt_core.components.pack import HX
from hdt_core.physics.model import Param
from hdt_core.records.keys import IN_ORDER, split_packs
from hdt_core.robust import MAD_TO_SD
from hdt_core.tracking.loss_filter import Loss, TrackResult, join_tracks, track_loss
from hdt_core.tracking.segments import SEGMENT_FLIGHTS
from hdt_core.tracking.sensor_shifts import CORRECTED
from hdt_core.tracking.wear_model import PACES, UNIT_SD, WEAR_STEP, Pace, Settings

LEAST_STEPS = 8
"""Steps between flights from which their scatter is estimated."""
SUDDEN_LOSS, FAULT_CHANCE, OFFSET_BIN = (0.2, 0.2), 1e-6, 0.03
"""Sudden losses are of any size, and with no second sensor a step is rather the part's than a fault's."""
WASH_SHARE = 0.5
"""Of the work that the log lacks, on a component that is cleaned."""
UNKNOWN_SD = 0.3
"""Of a design without a declared prior, about the calibrated one. [ln loss]"""


class DesignOffset(NamedTuple):
    """Offset of a pack's clean level from the calibrated design, in the units of wear, with its sd.

    The clean level is that of the declared design, or of the pack's sisters; `unit_sd` is the spread between units
    where these show it.
    """

    shift: float = 0.0
    sd: float = UNKNOWN_SD
    unit_sd: float | None = None


def track_component(
    flights: pl.DataFrame,
    component: Component,
    maintenance: pl.DataFrame,
    offset: DesignOffset | None = None,
    previous: TrackResult | None = None,
    seal: str = "",
) -> TrackResult:
    """Filter the health parameters of every flight along each pack.

    The filter is the exchanger's, for units that differ, enter worn, are renewed and washed, with wear scaled to the
    component: losses by the loss at which it fails, rates by its life, the walk of wear by the declared drift.

    Parameters
    ----------
    flights : DataFrame
        Of `flight_by_flight` with the health parameters free; whole packs.
    component : Component
        Entries of the log with its `ended_by` count.
    maintenance : DataFrame
        `operator, tail, pack, component, action, done_on`.
    offset : DesignOffset, optional
        Offset of the declared design.
    previous, seal
        As of `track_loss`.

    Returns
    -------
    TrackResult
        A flight's weight follows from the scatter of the segments before its own; only in the
        first segment, in which the design is still being calibrated, also from later ones.

    Raises
    ------
    ValueError
        There is no flight.
    """
    if flights.is_empty():
        raise ValueError(f"{component.model.name}: no flight to follow")
    rows = flights.sort(IN_ORDER)
    offset = offset or DesignOffset()
    losses = (_loss(rows, param, component, offset) for param in component.model.free("health"))
    return join_tracks(track_loss(rows, maintenance, loss, previous, seal) for loss in losses)


def _loss(flights: pl.DataFrame, param: Param, component: Component, offset: DesignOffset) -> Loss:
    """Build one parameter's loss from the flights' estimates."""
    size, settings = wear_settings(component, param, offset)
    estimates = flights.select(pl.when(~pl.col("status").is_in(WITHOUT_ESTIMATE)).then(param.name), f"{param.name}_sd")
    loss, loss_sd = estimates.to_numpy().astype(float).T
    shift, shift_sd = _sensor_shift(flights, loss, param, component)
    wear, sd = (x / size for x in wear_of(loss - shift, loss_sd, param))
    variance = np.where(np.isfinite(wear), sd**2 + scatter_by_segment(flights, wear, sd**2) ** 2, 1.0)
    status = (
        pl.when(pl.Series(~np.isfinite(wear))).then(pl.lit("predicted"))
        .when(pl.Series(shift_sd > 0.0)).then(pl.lit(CORRECTED))
        .otherwise(pl.lit("ok"))
    )  # fmt: skip
    observations = (-wear - offset.shift / size, variance, np.ones_like(wear))
    return Loss(component, param, size, settings, observations, status, (shift_sd**2,))


def _sensor_shift(flights: pl.DataFrame, loss: Array, param: Param, component: Component) -> tuple[Array, Array]:
    """Return the part of each flight's loss that shifted sensors feign, and its sd in wear; 0 where none is known."""
    if param.name != component.loss or "sensor_shift" not in flights.columns:
        return np.zeros_like(loss), np.zeros_like(loss)
    shift, shift_sd = flights.select("sensor_shift", "sensor_shift_sd").to_numpy().T
    return shift, np.nan_to_num(wear_of(loss - shift, shift_sd, param)[1])


def wear_settings(component: Component, param: Param, offset: DesignOffset) -> tuple[float, Settings]:
    """Return the component's wear at failure over the exchanger's, and the filter's settings scaled by it."""
    size = wear_size(component, param)
    rate_ratio = HX.life_flights / component.life_flights
    factors = np.array([1.0, rate_ratio, rate_ratio, rate_ratio**1.5, rate_ratio**1.5])
    paces = tuple(Pace(*(factors * pace).tolist()) for pace in PACES)
    known_sd = param.unit_sd if offset.unit_sd is None or param.name != component.loss else offset.unit_sd
    unit_sd = (UNIT_SD if known_sd is None else known_sd) / size
    walk = param.drift / size or WEAR_STEP
    entries = entry_classes(component.new_share)
    washes = WASH_SHARE * (CLEANED in component.ended_by)
    return size, Settings(
        0.0, offset.sd / size, unit_sd, unit_sd, paces, walk, SUDDEN_LOSS, FAULT_CHANCE, washes, OFFSET_BIN, entries
    )


def wear_size(component: Component, param: Param) -> float:
    """Return the component's wear at failure over the exchanger's."""
    return _wear_at_failure(component, param) / _wear_at_failure(HX, HX.model.param(HX.loss))


def entry_classes(new_share: float) -> tuple[EntryWear, ...]:
    """Return the exchanger's classes of units at entry with another share of new ones."""
    factor = (1.0 - new_share) / sum(e.share for e in ENTRY if not e.is_new)
    return tuple(e._replace(share=new_share if e.is_new else factor * e.share) for e in ENTRY)


def _wear_at_failure(component: Component, param: Param) -> float:
    return float(wear_of(np.array(component.limit.mean), np.array(0.0), param)[0])


def wear_of(loss: Array, sd: Array, param: Param) -> tuple[Array, Array]:
    """Convert a loss and its sd to wear, -ln(1 - loss), and its sd; a loss that can exceed 1 stays as it is."""
    return (-np.log1p(-loss), sd / (1.0 - loss)) if param.is_share else (loss, sd)


def scatter_by_segment(flights: pl.DataFrame, wear: Array, own_variance: Array, usual_sd: float | None = None) -> Array:
    """Estimate each flight's sd about its pack's health beyond its own, from the segments before: from no later flight.

    The first segment has `usual_sd`, or where that is not given the sd of its own flights.
    """
    scatter = np.empty(len(wear))
    for rows in split_packs(flights):
        for first in range(0, len(rows), SEGMENT_FLIGHTS):
            past = rows[: first or (SEGMENT_FLIGHTS if usual_sd is None else 0)]
            sd = scatter_sd(wear[past], own_variance[past], usual_sd or MIN_FLIGHT_SD)
            scatter[rows[first : first + SEGMENT_FLIGHTS]] = sd
    return scatter


def scatter_sd(wear: Array, own_variance: Array, usual_sd: float = MIN_FLIGHT_SD) -> float:
    """Estimate a flight's sd about its pack's health beyond its own from the steps between a pack's flights.

    `wear` is NaN where a flight has no estimate; `usual_sd` is the answer where steps are few.
    """
    has_wear = np.isfinite(wear)
    steps = np.diff(wear[has_wear])
    if len(steps) < LEAST_STEPS:
        return usual_sd
    excess_var = (MAD_TO_SD * np.median(np.abs(steps))) ** 2 / 2.0 - own_variance[has_wear].mean()
    return float(np.sqrt(max(excess_var, MIN_FLIGHT_SD**2)))
