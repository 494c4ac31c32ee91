"""What people read of flights that are held."""

import duckdb
import pytest

from pipelines.intake.faults import REASONS
from pipelines.intake.held import clock_fault, held_lines
from pipelines.words import use_language

ONE = {"operator": "AQX", "tail": "LX-AAA", "reason": "out_of_reach", "likely_cause": "year", "n": 1, "flight_id": "F"}


@pytest.mark.parametrize(
    ("group", "line"),
    [
        (ONE, f"AQX LX-AAA: F. {REASONS['out_of_reach'].sentence} Likely cause: another year."),
        (
            ONE | {"n": 3},
            f"AQX LX-AAA: 3 flights from F on. {REASONS['out_of_reach'].sentence} Likely cause: another year.",
        ),
        (
            ONE | {"reason": "copy_of_flight", "likely_cause": "operator_BZR"},
            f"AQX LX-AAA: F. {REASONS['copy_of_flight'].sentence} Likely cause: BZR delivered the flights too.",
        ),
        (
            ONE | {"reason": "misfiled", "likely_cause": "aircraft_LX-AAB", "other_flight_id": "B"},
            f"AQX LX-AAA: F. {REASONS['misfiled'].sentence} Likely cause: recorders of LX-AAA and LX-AAB exchanged; "
            "in LX-AAB's record they follow B.",
        ),
        (ONE | {"reason": "no_flight", "likely_cause": None}, f"AQX LX-AAA: F. {REASONS['no_flight'].sentence}"),
    ],
)
def test_held_flights_share_a_line(group, line):
    assert held_lines([group]) == [line]


def test_other_languages_name_the_cause():
    with use_language("de"):
        assert held_lines([ONE])[0].endswith("Wahrscheinliche Ursache: ein anderes Jahr.")


@pytest.mark.parametrize(("n_late", "is_wrong"), [(0, False), (2, False), (3, True)])
def test_flights_after_clock_show_it_wrong(n_late, is_wrong):
    with duckdb.connect() as con:
        con.execute("create schema tables")
        flights = "select 'AQX' as operator, range::varchar as flight_id"
        con.execute(f"create table tables.raw_deliveries as {flights}, 'f' || range as file, 1 as loaded from range(9)")
        con.execute(f"create table held_flights as {flights}, 'after_clock' as reason from range({n_late})")

        assert bool(clock_fault(con, ["f0", "f1", "f2", "f3"])) is is_wrong
