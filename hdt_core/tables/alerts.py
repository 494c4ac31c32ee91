"""The table of alerts."""

import dataframely as dy

from hdt_core.tables.base import Table, column, moment, operator_key, pack_key, text


class FeaturesAlerts(Table):
    """One case that needs a person's attention."""

    alert_id = text("hash of pack, diagnosis, sensor and first flight", nullable=False, primary_key=True)
    operator = operator_key(primary_key=False)
    tail = text("aircraft", nullable=False)
    pack = pack_key()
    component = text("HX, CC, RAM_DOOR, SENSOR or the code of a declared component", nullable=False)
    diagnosis = text(
        "code of the diagnosis, of unnest(tables.diagnoses()) or of a declared component",
        nullable=False,
    )
    sensor = text("SENSOR_FAULT: sensor at fault or, where a loss was found clean, the component; null for others")
    raised_flight_id = text("flight after which it was raised", nullable=False)
    raised_at = moment("departure of the flight after which it was raised")
    closed_at = moment(
        "departure of the first flight without it; where none has flown since the work that ended it, when that counts",
        nullable=True,
    )
    severity = text("low, medium or high, after now_flight_id", nullable=False)
    evidence = text("when raised: what moved, by how much, since when, and what corroborates it", nullable=False)
    evidence_phrases = text("JSON: evidence in phrases and values, to be written in another language", nullable=False)
    recommended_action = text("what to do", nullable=False)
    action_phrases = text("JSON: recommended_action in phrases and values", nullable=False)
    raised_severity = text("low, medium or high when raised", nullable=False)
    now_flight_id = text("last flight of the pack, or of a closed alert the last while it was open", nullable=False)
    evidence_now = text("the same as evidence, after now_flight_id", nullable=False)
    evidence_now_phrases = text("JSON: evidence_now in phrases and values", nullable=False)
    closed_reason = text(
        "renewed (another or a repaired part flies), found_clean (an inspection found nothing) or recovered (the "
        "loss or fault is no longer estimated); null while open"
    )
    follows = text("alert that was found clean, of one that came back because the loss grew on")
    units_in_90_days = column(
        dy.Int64,
        "units of the component on this position in the 90 days before it was raised, its own included; null for "
        "sensors and doors",
        "-",
        nullable=True,
    )
