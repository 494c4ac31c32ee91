"""Stage features: what the differences mean, and the alerts they raise."""

from hdt_core.tables.base import Table, flight_key, moment, operator_key, pack_key, tail_key, text


class Features(Table):
    """What is known of a pack after a flight, one column a feature: flight, pack."""

    operator = operator_key()
    tail = tail_key()
    flight_id = flight_key()
    pack = pack_key()
    departed_at = moment("first recorded time")


class FeaturesAlerts(Table):
    """One case that wants a person's attention."""

    alert_id = text("stable name of the case", nullable=False, primary_key=True)
    operator = operator_key(primary_key=False)
    tail = text("aircraft", nullable=False)
    pack = pack_key()
    component = text("HX, CC, RAM_DOOR or SENSOR", nullable=False)
    diagnosis = text("HX_FOULING, HX_SUDDEN_CLOG, CC_DEGRADED, RAM_DOOR_FAULT or SENSOR_FAULT", nullable=False)
    raised_flight_id = text("flight after which it was raised", nullable=False)
    raised_at = moment("departure of that flight")
    closed_at = moment("departure of the flight after which it was closed", nullable=True)
    severity = text("low, medium or high", nullable=False)
    evidence = text("what moved, by how much, since when", nullable=False)
    recommended_action = text("what to do", nullable=False)
