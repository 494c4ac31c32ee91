"""Faults drawn on a small fleet: what each changes, what counts as named, and that a night leaves none silent."""

import os
from dataclasses import replace
from datetime import date

import numpy as np
import pytest

from benchmarks.record import FIRST, SAMPLES, Life, Outcome, PackOutcome, compare, draw_all
from benchmarks.record_faults import KINDS, Fault, Record, read_record

DRAWS = int(os.environ.get("HDT_DRAWS", "30"))
NEVER_SILENT = set(KINDS) - {"swap", "duplicate", "relabel", "misfile"}
"""docs/bad-input.md gives the limits of the other kinds."""
FLIGHT = "A9-BAB_20240415_01"
PACK = PackOutcome(1, "none", 0.10, 0.02, 200.0)
LIFE = Life(1, "HX", None, 90)
SOUND = Outcome(frozenset(), frozenset(), [PACK], [LIFE], frozenset())


@pytest.fixture(scope="module")
def record() -> Record:
    """Ten days of an aircraft that has its own share of work and messages."""
    return read_record(SAMPLES, "BZR", "A9-BAC", FIRST, date(2024, 6, 12))


@pytest.fixture
def fault(record) -> Fault:
    """One flight is changed."""
    return Fault("shift", 60.0, frozenset({FLIGHT}), record)


def changed_flights(before: Record, after: Record) -> set[str]:
    """Flights that one record has not got, or has with other rows."""
    common = before.flights.keys() & after.flights.keys()
    differing = {f for f in common if not before.flights[f].equals(after.flights[f])}
    return differing | (before.flights.keys() ^ after.flights.keys())


@pytest.mark.parametrize("kind", KINDS)
def test_fault_names_every_changed_flight(kind, record):
    fault = KINDS[kind](np.random.default_rng(3), record)

    assert changed_flights(record, fault.record) <= fault.flights


@pytest.mark.parametrize("kind", KINDS)
def test_fault_changes_record(kind, record):
    fault = KINDS[kind](np.random.default_rng(3), record)

    is_other_log = not record.maintenance.equals(fault.record.maintenance)
    assert changed_flights(record, fault.record) or is_other_log


@pytest.mark.parametrize(
    "faulty",
    [
        replace(SOUND, packs=[PACK._replace(urgency="act")]),
        replace(SOUND, packs=[PACK._replace(loss=0.13)]),
        replace(SOUND, packs=[PACK._replace(flights_left=140.0)]),
        replace(SOUND, packs=[PACK._replace(loss=None)]),
        replace(SOUND, lives=[LIFE._replace(ended_by="replaced")]),
        replace(SOUND, lives=[LIFE._replace(n_flights=80)]),
        replace(SOUND, alerts=frozenset({(1, "SENSOR_FAULT", "tat_k")})),
    ],
    ids=["urgency", "loss", "forecast", "no loss", "end of a life", "length of a life", "alert"],
)
def test_unexplained_move_is_silent(fault, faulty):
    assert compare(fault, 1, SOUND, faulty).is_silent


def test_chance_move_counts_as_none(fault):
    faulty = replace(SOUND, packs=[PACK._replace(loss=0.11, flights_left=180.0)], lives=[LIFE._replace(n_flights=91)])

    assert not compare(fault, 1, SOUND, faulty).has_moved


@pytest.mark.parametrize(("flight", "is_found"), [(FLIGHT, True), ("A9-BAB_20240415_02", False)])
def test_reason_counts_for_its_flight(fault, flight, is_found):
    faulty = replace(SOUND, reasons=frozenset({(flight, "", "out_of_reach")}))

    assert compare(fault, 1, SOUND, faulty).is_found == is_found


def test_visible_faults_are_never_silent():
    verdicts = list(draw_all(DRAWS, workers=2))

    visible = [v for v in verdicts if v.kind in NEVER_SILENT]
    assert [v for v in visible if v.is_silent] == []
    assert sum(v.n_other_held for v in visible) <= sum(v.n_other for v in visible) / 1_000
