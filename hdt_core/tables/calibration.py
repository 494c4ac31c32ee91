"""Tables of stage calibration: design parameters and the Digital System Model."""

import dataframely as dy

from hdt_core.tables.base import AircraftTable, Table, column, count, flag, moment, number, text


class CalibrationDsm(Table):
    """The Digital System Model in service."""

    dsm_version = text("hash of what it was calibrated from", nullable=False, primary_key=True)
    model = text("the model as JSON", nullable=False)
    n_flights = count("flights it was calibrated from")
    status = text(
        "how the estimate of the exchanger's design ended: converged, at_bound, max_steps or not_identifiable"
    )


class CalibrationSchedules(Table):
    """One set of the fleet's laws, learned from the commissioning window."""

    name = text("legs: of the leg filter; controllers: of the cross checks", nullable=False, primary_key=True)
    laws = text("the laws as JSON", nullable=False)


class CalibrationWindow(AircraftTable):
    """The commissioning window of an aircraft: the flights that calibrate its models."""

    n_flights = count("flights in it", "flights")
    from_at = moment("departure of its first flight")
    until_at = moment("departure of its last flight")


class CalibrationDesign(Table):
    """One design parameter: scope, component, parameter."""

    scope = text("fleet, operator or tail", nullable=False)
    operator = text("operator, null above one")
    tail = text("aircraft, null above tail")
    pack = column(dy.Int32, "pack, null above a pack", nullable=True)
    component = text("HX or CC", nullable=False)
    parameter = text("name", nullable=False)
    value = number("estimate, in `unit`")
    sd = number("standard deviation, in `unit`", low=0)
    unit = text("unit, with the reference condition where it has one", nullable=False)
    n_flights = count("flights it rests on")
    identifiable = flag("the data, not the prior, decide it")
    dsm_version = text("model it belongs to", nullable=False)
