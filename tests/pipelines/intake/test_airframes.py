"""Which airframe a line of the fleet list is, and which lines contradict each other."""

from datetime import date, timedelta

import polars as pl
import pytest

from pipelines.intake.airframes import find_airframes, overlapping_folders, undated_folders, with_airframe
from pipelines.intake.landing_file import LandingFile
from pipelines.intake.logs import FleetLine

DAY = date(2024, 5, 20)
BEFORE = DAY - timedelta(days=1)
FIRST = ("AQX", "LX-AAC")
LATER = ("AQX", "LX-ZZC")
LEASED = ("BZR", "LX-AAC")


def line(folder, msn="40002", since=None, until=None, delivered=None) -> FleetLine:
    return FleetLine(*folder, msn, since, until, delivered)


@pytest.mark.parametrize(
    ("lines", "keys"),
    [
        ([line(FIRST), line(LATER)], [FIRST, FIRST]),
        ([line(LATER, since=DAY), line(FIRST, until=BEFORE)], [FIRST, FIRST]),
        ([line(FIRST), line(LEASED)], [FIRST, FIRST]),
        ([line(FIRST, msn=None), line(LATER, msn=None)], [FIRST, LATER]),
        ([line(FIRST), line(LATER, msn="49999")], [FIRST, LATER]),
        ([line(FIRST, since=DAY, delivered=date(2010, 1, 1)), line(LATER, since=BEFORE, until=BEFORE)], [LATER, LATER]),
    ],
    ids=["registered anew", "dated and in disorder", "leased", "without msn", "two airframes", "after delivery"],
)
def test_key_is_name_of_earliest_line(lines, keys):
    assert find_airframes(lines).keys == keys


def test_reused_registration_is_another_airframe():
    lines = [line(FIRST, until=BEFORE), line(FIRST, msn="49999", since=DAY)]

    tenures = find_airframes(lines).tenures(FIRST)

    assert [(t.since, t.airframe) for t in tenures] == [(date.min, FIRST), (DAY, ("AQX", "LX-AAC.2"))]


def test_delivery_day_parts_undated_lines():
    lines = [line(FIRST, delivered=date(2015, 1, 1)), line(FIRST, msn="49999", delivered=DAY)]

    assert [t.since for t in find_airframes(lines).tenures(FIRST)] == [date.min, DAY]


def test_next_day_belongs_to_the_next_line():
    lines = [line(FIRST, until=BEFORE), line(FIRST, msn="49999", delivered=DAY + timedelta(days=9))]

    assert [t.since for t in find_airframes(lines).tenures(FIRST)] == [date.min, DAY]


@pytest.mark.parametrize(("day", "tail"), [(BEFORE, "LX-AAC"), (DAY, "LX-AAC.2")])
def test_work_is_of_the_airframe_of_its_day(day, tail):
    context = f"airframe=0001-01-01,AQX,LX-AAC,;{DAY},AQX,LX-AAC.2,"
    file = LandingFile("", "AQX/LX-AAC/maintenance.csv", *FIRST, "maintenance", 1, 1, context=context)
    rows = pl.DataFrame({"operator": ["AQX"], "tail": ["LX-AAC"], "done_on": [day]})

    assert with_airframe(rows, file)["tail"].to_list() == [tail]
    assert file.tenure(day).airframe == ("AQX", tail)


@pytest.mark.parametrize("dated", [{"until": BEFORE}, {}], ids=["dated", "undated"])
def test_flights_decide_on_undated_lines_alone(dated):
    assert undated_folders([line(FIRST, **dated), line(LATER)]) == (set() if dated else {FIRST, LATER})


def test_lease_keeps_flights_apart():
    assert find_airframes([line(FIRST), line(LEASED)]).tenures(LEASED)[0].prefix == "BZR."


def test_ordinary_line_changes_no_name():
    assert find_airframes([line(FIRST), line(LATER, msn="40003")]).tenures(FIRST) == []


@pytest.mark.parametrize(
    "lines",
    [
        [line(FIRST, until=DAY), line(LATER, since=DAY)],
        [line(FIRST), line(FIRST, msn="49999")],
        [line(FIRST, until=DAY), line(FIRST, msn="49999", since=DAY)],
        [line(FIRST, since=DAY), line(FIRST, msn="49999", since=DAY)],
    ],
    ids=["one msn, two names", "undated lines of one tail", "one tail, two msn", "one begin"],
)
def test_contradicting_lines_count_without_msn(lines):
    airframes = find_airframes(lines)

    assert len(airframes.contradictions) == 1
    assert airframes.keys == [own.folder for own in lines]


@pytest.mark.parametrize(
    ("later_from", "apart"), [(100, False), (98, False), (40, True)], ids=["in turn", "misdated", "at the same time"]
)
def test_flown_days_part_one_msn(later_from, apart):
    days = {
        FIRST: [DAY + timedelta(days=k) for k in range(100)],
        LATER: [DAY + timedelta(days=k) for k in range(later_from, later_from + 60)],
    }

    assert overlapping_folders([line(FIRST), line(LATER)], days) == ({FIRST, LATER} if apart else set())


@pytest.mark.parametrize(
    ("n_flights", "n_misdated", "apart"), [(100, 5, False), (100, 6, True), (10, 2, False), (10, 3, True)]
)
def test_few_misdated_flights_are_no_overlap(n_flights, n_misdated, apart):
    """A twentieth of the shorter record, and two at least."""
    places = [*range(n_misdated), *range(100 + n_misdated, 100 + n_flights)]
    days = {
        FIRST: [DAY + timedelta(days=k) for k in range(100)],
        LATER: [DAY + timedelta(days=k) for k in places],
    }

    assert bool(overlapping_folders([line(FIRST), line(LATER)], days)) is apart
