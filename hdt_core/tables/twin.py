"""Tables of calibration, twin and residuals: design, each pack's health flight by flight, sensor against model against
twin; and those that only declared components have, with the component as part of the key."""

import dataframely as dy

from hdt_core.tables.base import (
    AircraftTable,
    ComponentLegTable,
    DatedLegTable,
    Table,
    column,
    component_key,
    count,
    flag,
    moment,
    number,
    pack_key,
    text,
)  # fmt: skip


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
    estimator = text("method that estimated it, and what finished its estimate; null in rows of before")


def _numbers(meaning: str) -> dy.List:
    return dy.List(dy.Float64(nullable=False), nullable=False, metadata={"unit": "-", "meaning": meaning})


class TwinFlights(DatedLegTable):
    """Estimate of a pack from one flight alone, against the Digital System Model: flight, pack."""

    status = text(
        "ok, few_samples; nothing estimated: no_cruise, diverged, not_identifiable; implausible: no core can have this",
        nullable=False,
    )
    n_samples = column(dy.Int32, "steady cruise samples behind the exchanger's estimates", "-", min=0)
    ln_ua_ratio = number("ln of measured over expected conductance, ram flow that of a clean duct")
    ln_ua_ratio_sd = number("random standard deviation of it", low=0)
    ln_ua_ratio_map_sd = number("standard deviation that the model's own uncertainty gives it", low=0)
    ua_w_k = number("measured conductance", "W/K", low=0)
    ua_expected_w_k = number("conductance the model expects of a clean core at this condition", "W/K", low=0)
    effectiveness = number("hot-side effectiveness")
    ram_flow_kg_s = number("ram flow by the clean duct's map", "kg/s", low=0)
    ln_ram_ratio = number("ln of ram flow by heat balance over the map's, where the ram outlet is measured")
    ln_ram_ratio_sd = number("random standard deviation of it", low=0)
    altitude_m = number("pressure altitude, median of the cruise samples; so for the other signals", "m")
    mach = number("Mach number")
    tat_k = number("total air temperature", "K")
    total_pressure_pa = number("total pressure", "Pa")
    hx_in_k = number("exchanger inlet, bleed side", "K")
    hx_out_k = number("exchanger outlet, bleed side", "K")
    ram_out_k = number("exchanger outlet, ram side", "K")
    ram_door_open = number("ram door position, 0 shut, 1 full open")
    pack_flow_kg_s = number("pack flow", "kg/s")
    ratio_per_exit_k = number("change of ln_ua_ratio if the outlet sensor reads 1 K more", "1/K")
    ratio_per_ln_flow = number("change of ln_ua_ratio by ln of the flow sensor's reading")
    ratio_per_tat_k = number("change of ln_ua_ratio if the TAT sensor reads 1 K more", "1/K")
    ratio_per_inlet_k = number("change of ln_ua_ratio if the inlet sensor reads 1 K more", "1/K")
    ratio_per_door = number("change of ln_ua_ratio by the door sensor's reading")
    flows_apart_ln = number("ln of pack flow over compressor flow, as recorded")
    tat_apart_k = number("TAT above the compressor's inlet temperature, as recorded", "K")
    exit_apart_k = number("exchanger outlet above the other pack's, while both doors can move", "K")
    inlet_apart_k = number("exchanger inlet above that by compressor discharge and both flows", "K")
    door_apart_ln = number("ln_ua_ratio of climb and descent above that of the cruise")
    cc_n_samples = column(dy.Int32, "cruise samples behind the compressor's estimates", "-", min=0)
    diameter_m = number("effective diameter, equation (5)", "m", low=0)
    diameter_m_se = number("scatter of its median", "m", low=0)
    expected_diameter_m = number("what equation (6) expects at this diffuser position", "m")
    group_m3 = number("area, diameter and tangent of the blade angle in one: equations (2)-(4)", "m3", low=0)
    group_m3_se = number("scatter of its median", "m3", low=0)
    efficiency = number("isentropic efficiency", low=0)
    efficiency_se = number("scatter of its median", low=0)
    vda_counts = number("diffuser position", "count")
    cc_status = text("how the compressor's method ended, where it gives no estimate")


class TwinHealth(ComponentLegTable):
    """One health parameter after a flight: flight, pack, parameter."""

    departed_at = moment("first recorded time")
    component = text("code of the component", nullable=False)
    parameter = text(
        "name; one that ends in _smoothed looks ahead, by 50 to 100 flights: for looking back, never for deciding",
        nullable=False,
        primary_key=True,
    )
    value = number(
        "estimate after this flight, in `unit`, from no later one but for those called smoothed; "
        "losses: 0 as built, larger is worse"
    )
    sd = number("standard deviation, in `unit`", low=0)
    unit = text("unit", nullable=False)
    status = text("how the estimate ended; the view `statuses` explains each", nullable=False)
    estimator = text(
        "method of the flight's own estimate; filtered where a filter along the flights finished it, smoothed where "
        "later flights did; kalman_filtered and the like in rows of before",
        nullable=False,
    )


class TwinCheckpoints(AircraftTable):
    """One of the hypotheses about a pack as a chapter of fifty flights began: a checkpoint from which nights go on."""

    pack = pack_key()
    component = component_key()
    parameter = text("health parameter whose track it continues", nullable=False, primary_key=True)
    chapter = column(
        dy.Int64, "chapter of the pack's flights, from 1; the first needs no checkpoint", "-", primary_key=True
    )
    seen = text("hash of the flights before the chapter and of the checkpoint's other inputs", nullable=False)
    history = column(dy.Int64, "number of the hypothesis within the checkpoint", "-", primary_key=True)
    log_weight = number("ln of its probability", nullable=False)
    mean = _numbers("wear [-], its rate [1/flight], offsets of sensors and unit [-], what is not the core's [-]")
    cov = _numbers("covariance of these five, row by row")
    pace = column(dy.Int64, "class of wear, an index of `PACES`", "-")
    since = column(dy.Int64, "flights since the core was renewed or washed", "-")
    unlogged = flag("no entry of the log has named that renewal yet")
    faulty = flag("a fault that is not the core's")


class Residuals(ComponentLegTable):
    """One signal's residual over a flight: flight, pack, signal, kind."""

    component = text("code of the component", nullable=False)
    signal = text("signal compared", nullable=False, primary_key=True)
    kind = text("sensor_minus_dsm, dsm_minus_twin or sensor_minus_twin", nullable=False, primary_key=True)
    mean = number("mean over the flight's samples, in `unit`")
    sd = number("standard deviation over the samples, in `unit`", low=0)
    rms = number("root mean square, in `unit`", low=0)
    unit = text("unit of the signal", nullable=False)
    n = count("samples")


class _Leg(ComponentLegTable):
    """A flight and pack of a component."""

    component = component_key()


class ComponentList(Table):
    """One component of the chain."""

    component = component_key()
    name = text("name in reports and alerts", nullable=False)
    loss = text("health parameter whose growth ends its life", nullable=False)
    lost = text("what it loses", nullable=False)
    message_code = text("the aircraft's own message when it fails")
    diagnosis = text("alert that calls it worn", nullable=False)
    limit_loss = number("loss at which it fails, before any failure was seen")
    recorded = flag("it has files of its own; else it is part of the pack")
    prior_sd = number("standard deviation of the loss of a unit at entry, before any flight", low=0)
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


class CalibrationSisters(AircraftTable):
    """Level of a clean unit by a pack's sisters: pack, component. In the unit of the design's parameter `_level`."""

    pack = pack_key()
    component = component_key()
    level = number("level of a clean unit, from all packs but this one", nullable=False)
    level_sd = number("standard deviation of it", low=0, nullable=False)
    unit_sd = number("spread between units as made", low=0, nullable=False)


class ResidualsComponents(Residuals):
    """One signal's residual of a declared component over a flight: flight, pack, signal, kind."""


class FeaturesComponents(_Leg):
    """Loss of a declared component after a flight, with its trends: flight, pack, component."""

    departed_at = moment("first recorded time")
    flight_index = column(dy.Int64, "the tail's flights, from 0")
    flights_seen_of_unit = column(dy.Int64, "flights of the unit before this", nullable=True)
    flights_since_drop = column(dy.Int64, "flights before this since the loss last fell, or of the unit", nullable=True)
    loss = number("loss after this flight, from no later one; 0 as built, larger is worse")
    loss_sd = number("standard deviation of it", low=0)
    loss_status = text("how that estimate ended")
    loss_slope_10_per_flight = number("trend of ten flights", "1/flight")
    loss_slope_30_per_flight = number("trend of thirty flights", "1/flight")
    loss_slope_100_per_flight = number("trend of a hundred flights", "1/flight")
    loss_jump_10 = number("gain over ten flights")
    loss_step_3 = number("gain of three flights over the twelve before, less the trend")
