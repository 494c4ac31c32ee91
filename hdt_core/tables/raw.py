"""Stages raw and legs: what was recorded, typed, in SI; where every delivered row went; which flights are nominal."""

import dataframely as dy
import polars as pl

from hdt_core.tables.base import (
    AircraftRows,
    AircraftTable,
    DatedLegTable,
    FlightTable,
    LegTable,
    Table,
    column,
    component_key,
    count,
    flag,
    flight_key,
    moment,
    number,
    operator_key,
    pack_key,
    tail_key,
    text,
)


class Signals(Table):
    """The recorder's signals in SI, without spans: a spike is a recorded value."""

    altitude_m = number("pressure altitude", "m")
    mach = number("Mach number", "-")
    tat_k = number("total air temperature (paper Table 3, no. 1)", "K")
    total_pressure_pa = number("total air pressure (no. 2)", "Pa")
    hx_in_k = number("heat exchanger hot-side inlet (no. 3)", "K")
    hx_out_k = number("heat exchanger hot-side exit (no. 4)", "K")
    ram_door_open = number("ram air inlet door, share open (no. 7)", "-")
    pack_flow_kg_s = number("pack mass flow (no. 8)", "kg/s")
    ram_out_k = number("ram air leaving the heat exchanger, where the sensor is fitted", "K")
    cc_speed_rad_s = number("centrifugal compressor shaft speed", "rad/s")
    cc_in_k = number("compressor inlet temperature", "K")
    cc_in_pa = number("compressor inlet pressure", "Pa")
    cc_out_k = number("compressor exit temperature", "K")
    cc_out_pa = number("compressor exit pressure", "Pa")
    cc_flow_kg_s = number("compressor inlet mass flow", "kg/s")
    vda_counts = number("variable diffuser actuator position", "counts")


SIGNALS = list(Signals.columns())


class SampleTable(Signals):
    """A table of samples: a leg begins the key."""

    operator = operator_key()
    tail = tail_key()
    flight_id = flight_key()
    pack = pack_key()


class RawSnapshots(SampleTable):
    """One ACMS snapshot: flight, pack, time."""

    time_utc = moment("time of the report", primary_key=True)
    source = text("acms or cpl", nullable=False)
    phase_code = text("the recorder's own flight phase, may be wrong")
    origin = text("ICAO code of the airport of departure, where the operator gives it")
    destination = text("ICAO code of the airport of arrival, where the operator gives it")
    file = text("file that delivered the row, below the landing zone", nullable=False)


class RawLogs(RawSnapshots):
    """One second of a continuous log: flight, pack, time."""


class RawFlights(FlightTable):
    """One flight on record."""

    departed_at = moment("first recorded time")
    landed_at = moment("last recorded time")
    source = text("acms, cpl or both", nullable=False)
    n_snapshots = count("ACMS snapshot times")
    n_seconds = count("seconds of continuous log")
    origin = text("ICAO code of the airport of departure, where the operator gives it")
    destination = text("ICAO code of the airport of arrival, where the operator gives it")
    first_altitude_m = number("first pressure altitude", "m")
    last_altitude_m = number("last pressure altitude", "m")
    highest_altitude_m = number("highest pressure altitude", "m")
    mean_altitude_m = number("mean pressure altitude", "m")
    first_mach = number("first Mach number", "-")
    last_mach = number("last Mach number", "-")
    highest_mach = number("highest Mach number", "-")
    mean_tat_k = number("mean total air temperature", "K")
    mean_hx_in_k = number("mean heat exchanger hot-side inlet of the packs", "K")
    highest_flow_kg_s = number("median flow of the pack that flows most", "kg/s")
    hx_in_between_packs_k = number("pack 1's mean hot-side inlet above pack 2's", "K")
    hx_out_between_packs_k = number("pack 1's mean hot-side exit above pack 2's", "K")
    cc_in_between_packs_k = number("pack 1's mean compressor inlet above pack 2's", "K")
    ram_door_between_packs = number("pack 1's mean ram door opening above pack 2's", "-")
    pack_flow_between_packs_kg_s = number("pack 1's mean flow above pack 2's", "kg/s")
    cc_speed_between_packs_rad_s = number("pack 1's mean compressor speed above pack 2's", "rad/s")
    cc_in_between_packs_pa = number("pack 1's mean compressor inlet pressure above pack 2's", "Pa")
    cc_out_between_packs_pa = number("pack 1's mean compressor exit pressure above pack 2's", "Pa")
    n_values = count("recorded values", nullable=True)
    clock_back_s = count("largest step back of the clock in the order of the file", "s", nullable=True)
    n_steps_back = count("steps back of the clock in the order of the file", nullable=True)
    log_fault = text("log_clock or log_packs where the log contradicts the snapshots, which then count alone")


class RecordHeld(FlightTable):
    """One flight that is stored and not used as delivered, for its time or identity can't be right."""

    departed_at = moment("first recorded time, as delivered")
    landed_at = moment("last recorded time, as delivered")
    reason = text("reason code", nullable=False)
    is_used = flag("whether it is used: each pack in its own place, or without its log")
    without_log = flag("whether its continuous log contradicts its snapshots, and is left out")
    likely_cause = text("code of what made it so, where the numbers show one")
    other_flight_id = text("flight that it copies, continues or overlaps, or one of the aircraft that it is like")
    file = text("file that delivered it, below the landing zone")
    held_since = moment("modification time of the file", nullable=True)


class RawDeliveries(Table):
    """Counts of a file's delivered rows by what became of them: file, flight."""

    operator = text("operator of the folder")
    tail = text("tail of the folder")
    file = text("file below the landing zone", nullable=False)
    flight_id = text("flight the rows belong to; rows that name none go with the file's first flight")
    delivered = count("rows in the file")
    loaded = count("rows stored")
    quarantined = count("rows kept aside with a reason")
    duplicate = count("repeats of another row")

    @dy.rule()
    def balances(cls) -> pl.Expr:  # noqa: N805, dataframely makes a class method of it
        """No row is lost and none is counted twice."""
        return pl.col("delivered") == pl.col("loaded") + pl.col("quarantined") + pl.col("duplicate")


class RawQuarantine(Table):
    """One rejected file, row or value."""

    file = text("file below the landing zone", nullable=False)
    row = column(dy.Int64, "line of the file, counted from 1 for the header; null for the whole file", nullable=True)
    column_name = text("column at fault, null where the row or file as a whole is")
    reason = text("reason code", nullable=False)
    detail = text("description of the fault")
    scope = text(
        "file, row, value (stored as null, its row goes on), result (a computed row) or note (nothing kept out)",
        nullable=False,
    )
    operator = text("operator of the folder")
    tail = text("tail of the folder")
    flight_id = text("flight the row belongs to; a row that names none goes with the file's first flight")
    received_at = moment("modification time of the file", nullable=True)
    n_rows = count("delivered rows this entry keeps out of the store: 1 for a row, 0 for a value or a note")
    content = text("the rejected row as it came, cut short")


class RawMessages(AircraftRows):
    """One maintenance message the aircraft raised."""

    message_time = moment("time raised")
    flight_id = text("flight it was raised on")
    pack = column(dy.Int32, "air-conditioning pack, 1 left, 2 right; null where none is named", nullable=True)
    code = text("message code", nullable=False)
    file = text("file below the landing zone")
    text = text("message text")


class RawReports(AircraftRows):
    """Bleed and pack states in the head of one printed ACMS report."""

    reported_at = moment("time printed in the head")
    report = text("number of the report", nullable=False)
    altitude_m = number("pressure altitude", "m")
    mach = number("Mach number", "-")
    pack_1_flow_kg_s = number("flow of pack 1", "kg/s")
    pack_2_flow_kg_s = number("flow of pack 2", "kg/s")
    bleed_1_open = flag("whether a bleed valve of engine 1 was open", nullable=True)
    bleed_2_open = flag("whether a bleed valve of engine 2 was open", nullable=True)
    crossfeed_open = flag("whether the cross-feed valve was open", nullable=True)
    file = text("file below the landing zone", nullable=False)
    file_version = text("digest of the file and of the layouts it was read by", nullable=False)


class RawMaintenance(AircraftRows):
    """One piece of work that was done."""

    done_on = column(dy.Date, "day the log gives, up to some flights late", "UTC")
    pack = column(dy.Int32, "air-conditioning pack, 1 left, 2 right; null where none is named", nullable=True)
    component = text("HX, CC, RAM_DOOR, SENSOR or the code of a declared component", nullable=False)
    action = text("REPLACED, CLEANED, INSPECTED or ADJUSTED", nullable=False)
    finding = text("FOULED, CLOGGED, CORRODED, DAMAGED, NO_FAULT_FOUND or nothing")
    reference = text("work order")
    done_at = moment("time of day, where the log gives one", nullable=True)
    counts_from = moment("flights that depart from then on count as flown after the work: `done_at`, or the day's end")
    serial_off = text("serial number of the unit that came off, where the log gives it")
    serial_on = text("serial number of the unit that went on, where the log gives it")
    status = text("COMPLETED, CLOSED, DONE or nothing, as the log gives it; raw_maintenance_not_done has any other")
    source = text("log: the maintenance log; case: an engineer who closed an alert")
    file = text("file below the landing zone, of a line of the log")
    closes_alert_id = text("alert that an engineer closed with this finding, by the id it had then")
    closes_diagnosis = text("its diagnosis")
    closes_sensor = text("its sensor, as in the table of alerts")
    since_night = flag("whether it was entered after the last night, which has not estimated with it", nullable=True)


LOG, CASE = "log", "case"
"""Sources of a row of `raw_maintenance`."""
CLOSES = {"closes_alert_id": "alert_id", "closes_diagnosis": "diagnosis", "closes_sensor": "sensor"}
"""Columns of `raw_maintenance` on the alert that work closed, and those of an alert that they are."""


class RawMaintenanceNotDone(RawMaintenance):
    """One piece of work on the log that was not done, by its status: planned, deferred, open or cancelled."""


class FeaturesWork(RawMaintenance):
    """One piece of work that renews a unit or lowers its loss, judged by the flights around it."""

    verdict = text(
        "logged (as the log has it), early (dated before the message after which the flights show it), late (logged "
        "after the flights show it), misdated (its year or month is wrong, or day and month are exchanged), elsewhere "
        "(done at the other position), ahead (dated over 30 days after the last flight: waits for the next one), "
        "repeated (listed before) or not_seen (ten flights since do not show it)",
        nullable=False,
    )
    in_force = flag("whether the work counts")
    position = column(dy.Int32, "pack worked on, by the flights", nullable=True)
    flown_from = moment("flights that depart from then on were flown after the work, by the flights")
    known_from = moment("from when the record let it count; null where that is not settled yet", nullable=True)
    known_until = moment("until when, where it turned out not to have been done, or to be listed twice", nullable=True)
    is_shown = flag("whether a loss recovered")


class RawChecks(AircraftTable):
    """One check that is planned for an aircraft."""

    planned_on = column(dy.Date, "day of the check", "UTC", primary_key=True)
    name = text("what it is called", nullable=False, primary_key=True)


class RawCosts(Table):
    """Cost of one item for a component: component, item."""

    component = component_key()
    item = text(
        "wash, replace, at_check (either, when it waits for a check) or message", nullable=False, primary_key=True
    )
    cost = number("what it costs, in `currency`", "currency", 0, nullable=False)
    currency = text("currency of the costs", nullable=False)
    horizon_days = count("how far ahead is looked where no check is planned", "days")
    source = text("costs.toml of the home, or default: a round figure of ours", nullable=False)


class RawCases(Table):
    """One action of a person on an alert, or the night's note that a case goes on; entries are never removed."""

    id = text(
        "the line's own id, random; of a line from before there were ids a hash of it", nullable=False, primary_key=True
    )
    line = column(dy.Int64, "place in the log, from 1")
    at = moment("when")
    case_id = text("stable name of the case: the first id of its alert", nullable=False)
    alert_id = text("the case's alert, by the id it had then", nullable=False)
    operator = operator_key(primary_key=False)
    tail = tail_key(primary_key=False)
    pack = column(dy.Int32, "air-conditioning pack, 1 left, 2 right", nullable=True)
    component = text("HX, CC, RAM_DOOR, SENSOR or the code of a declared component", nullable=False)
    diagnosis = text("diagnosis of the alert", nullable=False)
    sensor = text("sensor of the alert, as in the table of alerts")
    kind = text(
        "acknowledge, assign, mute, watch, unwatch, close or reopen; follow (the night: the case goes on with this "
        "alert) or withdraw (the night: its alert is no longer raised)",
        nullable=False,
    )
    person = text("who; night, of its own lines", nullable=False)
    assignee = text("assign: to whom")
    until = moment("mute: until when", nullable=True)
    note = text("why, or what else there is to say")
    finding = text("close: FOULED, CLOGGED, CORRODED, DAMAGED or NO_FAULT_FOUND")
    action = text("close: REPLACED, CLEANED, INSPECTED or ADJUSTED")
    reference = text("close: work order")
    done_on = column(dy.Date, "close: day of the work", "UTC", nullable=True)
    done_at = moment("close: its time of day, where it was given", nullable=True)
    severity_then = text("severity of the alert at that moment")
    loss_then = number("loss of its component at that moment")
    p_event_50_then = number("chance of an event within 50 flights at that moment", "-", 0, 1)
    raised_then = moment("when the alert was raised, as known at that moment", nullable=True)
    last_then = moment("when it closed or, while open, its last flight, as known at that moment", nullable=True)


class RawCoverage(AircraftTable):
    """Whether a parameter can be estimated for an aircraft that has a type: aircraft, parameter."""

    type = text("type of the aircraft, as in fleet.csv", nullable=False)
    component = component_key()
    parameter = text("health parameter", nullable=False, primary_key=True)
    status = text("recorded, or not_recorded: nothing can be estimated", nullable=False)
    missing = text("columns without which it can't be estimated")
    why = text("why they are missing, by the type's description")


class RawFleet(AircraftRows):
    """One line of the fleet list: an airframe under one operator and tail."""

    msn = text("manufacturer's serial number; null where lines contradict each other")
    valid_from = column(dy.Date, "first day on which the line holds; null where it is open", "UTC", nullable=True)
    valid_to = column(dy.Date, "last day on which the line holds; null where it is open", "UTC", nullable=True)
    delivered_on = column(dy.Date, "day of delivery to this operator", "UTC", nullable=True)
    packs = column(dy.Int32, "air-conditioning packs", "-", nullable=True)
    type = text("type whose description its recordings follow; null where its files are the default record")
    airframe_operator = text("operator under which rows of the airframe stand")
    airframe_tail = text("tail under which rows of the airframe stand")
    flight_prefix = text("what ids of its flights begin with, as stored, before the delivered one")


class LegsSamples(SampleTable):
    """One usable sample, without values outside a sensor's range: flight, pack, time."""

    time_utc = moment("time of the sample, the middle of an averaged window", primary_key=True)
    source = text("acms or cpl", nullable=False, primary_key=True)
    departed_at = moment("first recorded time of the flight")
    phase = text("ground, climb, cruise or descent, from altitude, Mach and time")
    nominal = flag("steady cruise, fit to calibrate from")
    monitored = flag("steady enough to judge health from, sick or not")
    n_averaged = count("seconds averaged, 1 for a snapshot")
    steady = flag("no driving signal on the move", nullable=True)
    level = flag("level flight", nullable=True)
    icing = flag("icing conditions", nullable=True)
    climb_rate_m_s = number("rate of climb", "m/s")
    n_out_of_range = count("values taken out because no sensor can show them", nullable=True)
    n_spikes = count("values taken out because the neighbours contradict them", nullable=True)
    n_frozen = count("values taken out because the sensor repeats itself", nullable=True)


class LegsVerdicts(DatedLegTable):
    """One leg as its own record shows it: flight, pack."""

    landed_at = moment("last recorded time")
    source = text("acms, cpl or both", nullable=False)
    n_snapshots = count("snapshots of the pack")
    cruise_minutes = number("time in cruise", "min", 0)
    admitted = flag("fit to calibrate from")
    reason = text("reason code, empty when admitted", nullable=False)
    n_samples = count("samples left after the sample filter")
    n_nominal = count("of these, nominal")
    n_monitored = count("of these, fit to judge health from")
    n_frozen = count("values taken out because the sensor repeats itself")


class LegsChannels(LegTable):
    """One channel that the recorder delivers otherwise than one reading a row: flight, pack, source, signal."""

    source = text("acms or cpl", nullable=False, primary_key=True)
    signal = text("signal as `raw_snapshots` names it", nullable=False, primary_key=True)
    reason = text(
        "not_fitted: zero throughout on both packs; one_channel: equals the other pack's digit for digit; lower_rate: "
        "empty in a pattern that repeats", nullable=False,
    )  # fmt: skip
    n_readings = count("readings concerned: zeros, equal ones, or regular gaps")
    delivered_share = number("of a lower rate, share of the rows that hold a reading", "-", 0, 1)


class LegsIndicators(LegTable):
    """Indicators of a leg by its own samples, against the fleet's laws: flight, pack."""

    index_level = number("conductance index, median of the leg: 0.1 less is a loss of about 10 %")
    index_n = count("samples behind it", nullable=True)
    index_unrest = number("how far a few samples in a row leave the leg's median, in standard errors", low=0)
    index_step = number("change of the index by one step of a coarse recorder's pack flow; 0 of a fine one", low=0)
    outlet_between_packs_k = number("exchanger outlet above the other pack's, while both doors can move", "K")
    outlet_above_law_k = number("exchanger outlet above the law the controllers hold", "K")
    inlet_minus_tat_k = number("compressor inlet above TAT", "K")
    inlet_over_total_pressure_ln = number("ln of compressor inlet over total pressure")
    pack_over_compressor_flow_ln = number("ln of pack flow over compressor flow")
    pack_flow_between_packs_ln = number("ln of pack flow over the other pack's")
    pack_flow_ln = number("ln of pack flow in kg/s")
    flow_step_ln = number("the recorder's step of pack or compressor flow over it; 0 where noise exceeds it", low=0)


class LegsAdmitted(DatedLegTable):
    """The final verdict on a leg, with the twin and the maintenance log at hand: flight, pack."""

    admitted = flag("fit to calibrate from")
    reason = text("reason code, empty when admitted", nullable=False)
    n_samples = count("samples left after the sample filter")
    n_nominal = count("of these, nominal")
