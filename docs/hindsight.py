"""Values of stored rows that a later night may change, with the reason.

Every other value of a row that names a flight or an alert is what the night of its month left, and the same whether a
landing zone was taken in night by night or at once; a test holds the chain to this list. Views of the present state
(rankings, open alerts, gaps) and sums over a history are not covered.
"""

from typing import NamedTuple


class Revision(NamedTuple):
    """Columns, or health parameters, of some tables and views that a later night may change."""

    tables: tuple[str, ...]
    names: tuple[str, ...]
    why: str


REVISIONS = (
    Revision(
        ("twin_health", "health_parameters"),
        ("hx_fouling_smoothed", "cc_efficiency_loss_smoothed", "cc_diameter_loss_smoothed", "<parameter>_smoothed"),
        "the smoother uses 50 to 100 later flights, so no decision uses its values",
    ),
    Revision(
        ("legs_admitted", "legs"),
        ("admitted", "reason", "n_nominal"),
        "the verdict on a leg, with hindsight: it selects legs for calibration and decides about no part",
    ),
    Revision(
        ("features_alerts", "alerts"),
        (
            *("closed_at", "closed_on", "closed_reason", "severity"),
            *("now_flight_id", "evidence_now", "evidence_now_phrases"),
        ),
        "the alert's present state; other columns hold its state when it was raised",
    ),
    Revision(
        ("prognosis_lives", "unit_lives"),
        ("ended_by", "censored", "n_flights", "end_row", "end_flight_id", "end_departed_at"),
        "a life ends when its end is on record",
    ),
    Revision(
        ("messages",),
        ("answered_by", "matched_by", "note"),
        "a message is answered by work that comes after it",
    ),
    Revision(
        ("training_set",),
        tuple(f"label_{c}_{name}" for c in ("hx", "cc") for name in ("flights", "censored", "ended_by")),
        "labels: events after the flight",
    ),
    Revision(
        ("prognosis_outcomes",),
        ("outcome", "seen_flights", "interval_held", "outlived_low", "outlived_high", "event_50"),
        "events after the flight; rows from the flight of an event on are removed once it is on record",
    ),
    Revision(
        ("prognosis_model",),
        ("card", "model"),
        "scores and the base's bytes are stored in the newest month's row alone",
    ),
    Revision(
        ("prognosis_model",),
        ("service",),
        "reasons for a month's fit and the base before it: the home's own history, not the record's",
    ),
)
DESIGN = (
    "Until an aircraft's commissioning window is flown (160 flights), each of its milestones calibrates the models "
    "anew and what follows from them is made anew, prognoses by their own month's model. Where an aircraft joins, the "
    "fleet's share of the models moves a little for all. Flights, messages and work that come late change the rows of "
    "the days that they concern."
)
"""Further causes of changes: the models of the aircraft, and the record itself."""
