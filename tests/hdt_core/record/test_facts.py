"""Facts of a flight from its recorded rows: its ends, its airports, steps back of the clock in the order of a file."""

from datetime import timedelta

import polars as pl
import pytest

from hdt_core.record.facts import flight_facts, ground_stops
from hdt_core.tables.raw import RawSnapshots
from tests.support.flight_lists import START

KEY = {"operator": "AQX", "tail": "LX-AAA", "flight_id": "LX-AAA_20240304_01", "source": "acms", "file": "a.csv"}


def facts_of(minutes: list[int], first_row: int = 2) -> dict:
    """Facts of one pack's reports at these minutes, in the order of their file."""
    rows = [
        KEY | {"pack": 1, "time_utc": START + timedelta(minutes=m), "row_in_file": first_row and first_row + k}
        for k, m in enumerate(minutes)
    ]
    frame = pl.DataFrame(rows)
    numbers = frame["row_in_file"]
    return flight_facts(RawSnapshots.conform(frame).with_columns(numbers)).row(0, named=True)


@pytest.mark.parametrize(
    ("minutes", "back_s", "n"),
    [
        ([0, 5, 10, 15], 0, 0),
        ([0, 5, 2, 7], 180, 1),
        ([0, 5, 2, 7, 3, 8], 240, 2),
        # parts of a file in exchanged order: nothing is missing between them
        ([10, 15, 0, 5], 0, 0),
        # and where three hours are, the clock was set
        ([240, 245, 0, 5], 14_700, 1),
    ],
)
def test_steps_back_are_counted(minutes, back_s, n):
    facts = facts_of(minutes)

    assert (facts["clock_back_s"], facts["n_steps_back"]) == (back_s, n)


def test_stored_rows_have_no_order():
    assert facts_of([0, 5, 2, 7], first_row=0)["n_steps_back"] == 0


def test_departure_is_the_first_time():
    assert facts_of([0, 5, 2, 7])["departed_at"] == START


def summarise(*reports: dict) -> dict:
    """Facts of a flight of a file of these reports: minute, and what differs from a snapshot of pack 1."""
    rows = [KEY | {"pack": 1, "time_utc": START + timedelta(minutes=r["minute"])} | r for r in reports]
    frame = RawSnapshots.conform(pl.DataFrame(rows, infer_schema_length=None))
    return flight_facts(frame.with_columns(row_in_file=pl.int_range(1, pl.len() + 1))).row(0, named=True)


def test_ends_are_the_first_and_last_reports():
    """Whatever their pack and order."""
    facts = summarise(
        {"minute": 85, "altitude_m": 3_000.0, "mach": 0.4},
        {"minute": 5, "altitude_m": 2_000.0, "mach": 0.35},
        {"minute": 90, "pack": 2, "altitude_m": 900.0, "mach": 0.25},
        {"minute": 0, "pack": 2, "altitude_m": 800.0, "mach": 0.2},
    )

    assert (facts["first_altitude_m"], facts["last_altitude_m"]) == (800.0, 900.0)
    assert (facts["first_mach"], facts["last_mach"]) == (0.2, 0.25)


@pytest.mark.parametrize(("source", "column"), [("acms", "n_snapshots"), ("cpl", "n_seconds")])
def test_moments_of_two_packs_count_once(source, column):
    moments = ({"minute": minute, "pack": pack, "source": source} for minute in (0, 5, 10) for pack in (1, 2))

    assert summarise(*moments)[column] == 3


def test_airport_may_come_late():
    assert summarise({"minute": 0}, {"minute": 5, "origin": "EGLL"})["origin"] == "EGLL"


@pytest.mark.parametrize("sources", [["acms"], ["cpl"], ["acms", "cpl"]], ids=" ".join)
def test_source_names_every_recorder(sources):
    reports = ({"minute": minute, "source": source} for source in sources for minute in (0, 5))

    assert summarise(*reports)["source"] == (sources[0] if len(sources) == 1 else "both")


def test_contradicting_log_moves_no_end():
    log = ({"minute": minute, "source": "cpl"} for minute in (600, 660))

    facts = summarise({"minute": 0}, {"minute": 90}, *log)

    assert (facts["log_fault"], facts["landed_at"]) == ("log_clock", START + timedelta(minutes=90))


def test_worst_pack_counts_the_steps_back():
    minutes = {1: [0, 5, 2, 7], 2: [0, 5, 2, 7, 3, 8]}
    reports = ({"minute": minute, "pack": pack} for pack, own in minutes.items() for minute in own)

    assert summarise(*reports)["n_steps_back"] == 2


def stops_between(*reports: tuple[int, float, float | None]) -> list[float]:
    """Ground stops of a flight with reports at these minutes, Mach numbers and altitudes. [s]"""
    rows = [
        {"flight_id": "one", "time_utc": START + timedelta(minutes=minute), "mach": mach, "altitude_m": altitude_m}
        for minute, mach, altitude_m in reports
    ]
    return ground_stops(pl.DataFrame(rows), ["flight_id"])["ground_stop_s"].to_list()


@pytest.mark.parametrize(
    ("landing_m", "departing_m", "minutes", "stops_s"),
    [
        (900.0, 900.0, 40, [2_400.0]),
        (900.0, 900.0, 20, []),
        (9_000.0, 900.0, 40, []),
        (900.0, 9_000.0, 40, []),
    ],
)
def test_ground_stop_is_between_low_reports(landing_m, departing_m, minutes, stops_s):
    landing = (60, 0.3, landing_m)
    departing = (60 + minutes, 0.3, departing_m)

    assert stops_between((0, 0.8, 9_000.0), landing, departing) == stops_s


def test_taxiing_reports_are_no_flight():
    assert stops_between((60, 0.3, 900.0), (80, 0.1, 900.0), (100, 0.3, 900.0)) == [2_400.0]


def test_highest_flow_is_of_the_pack_that_flows():
    rows = [
        KEY | {"pack": pack, "time_utc": START + timedelta(minutes=minute), "row_in_file": 0, "pack_flow_kg_s": flow}
        for pack, flows in ((1, (0.0, 0.0, 0.9)), (2, (0.7, 0.8, 5.0)))
        for minute, flow in enumerate(flows)
    ]

    facts = flight_facts(RawSnapshots.conform(pl.DataFrame(rows)).with_columns(row_in_file=0))

    assert facts["highest_flow_kg_s"].to_list() == [0.8]
