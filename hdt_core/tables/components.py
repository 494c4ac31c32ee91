"""Tables that only declared components have, with the component as part of the key."""

from typing import Any

import dataframely as dy

from hdt_core.tables.base import (
    ComponentLegTable,
    Table,
    column,
    count,
    flag,
    moment,
    number,
    text,
)  # fmt: skip
from hdt_core.tables.calibration import CalibrationDesign
from hdt_core.tables.residuals import Residuals


def _component(**kw: Any) -> dy.String:
    return text("code of the component", nullable=False, primary_key=kw.pop("primary_key", True), **kw)


class _Leg(ComponentLegTable):
    """A flight and pack of a component."""

    component = _component()


class ComponentList(Table):
    """One component of the chain."""

    component = _component()
    name = text("name in reports and alerts", nullable=False)
    loss = text("health parameter whose growth ends its life", nullable=False)
    lost = text("what it loses", nullable=False)
    message_code = text("the aircraft's own message when it fails")
    diagnosis = text("alert that calls it worn", nullable=False)
    limit_loss = number("loss at which it fails, before any failure was seen")
    recorded = flag("it has files of its own; else it is part of the pack")
    version = text("digest of its declaration", nullable=False)


class RawComponents(_Leg):
    """One recorded value of a component: flight, pack, time, signal."""

    time_utc = moment("time of the sample", primary_key=True)
    signal = text("signal, its unit at the end of the name", nullable=False, primary_key=True)
    value = number("value in SI")
    file = text("file that delivered it, below the landing zone", nullable=False)


class LegsComponents(_Leg):
    """One leg of a component: flight, pack."""

    departed_at = moment("first recorded time")
    admitted = flag("fit to calibrate from")
    reason = text("reason code, empty when admitted", nullable=False)
    n_samples = count("samples on record")
    n_nominal = count("of these, samples to which the model applies")


class CalibrationComponents(CalibrationDesign):
    """One design parameter of a declared component, by pack."""


class ResidualsComponents(Residuals):
    """One signal's residual of a declared component over a flight: flight, pack, signal, kind."""


class FeaturesComponents(_Leg):
    """Loss of a declared component after a flight, with its trends: flight, pack, component."""

    departed_at = moment("first recorded time")
    flight_index = column(dy.Int64, "the tail's flights, from 0")
    flights_seen_of_unit = column(dy.Int64, "flights of the unit before this", nullable=True)
    loss = number("loss after this flight, from no later one; 0 as built, larger is worse")
    loss_sd = number("standard deviation of it", low=0)
    loss_status = text("how that estimate ended")
    loss_slope_10_per_flight = number("trend of ten flights", "1/flight")
    loss_slope_30_per_flight = number("trend of thirty flights", "1/flight")
    loss_slope_100_per_flight = number("trend of a hundred flights", "1/flight")
    loss_jump_10 = number("gain over ten flights")
    loss_step_3 = number("gain of three flights over the twelve before, less the trend")
