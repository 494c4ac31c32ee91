"""Lines of logs and lists that lie ahead, too early or on the limit; when a log with lines ahead is read again."""

from datetime import UTC, date, datetime

import pytest

from pipelines.intake.landing_file import FileIntake
from pipelines.intake.logs import FARTHEST, read_checks, read_maintenance, read_messages

HEADS = {
    "messages": "message_time,flight_id,pack,code,text",
    "maintenance": "done_on,pack,component,action,finding,reference,status",
    "checks": "operator,tail,date,name",
}
READERS = {"messages": read_messages, "maintenance": read_maintenance, "checks": read_checks}
FLEET = b"operator,tail,delivered_on\nAQX,LX-AAA,2014-06-01\n"


@pytest.fixture
def read(deliver, now):
    """Read a log of some lines in 2026."""

    def call(kind: str, *lines: str) -> FileIntake:
        path = "checks.csv" if kind == "checks" else f"AQX/LX-AAA/{kind}.csv"
        files = deliver({"fleet.csv": FLEET, path: "\n".join([HEADS[kind], *lines, ""]).encode()})
        return READERS[kind](next(f for f in files if f.kind == kind), now)

    return call


def messages(*times: str) -> list[str]:
    return [f"{time},,1,21-52-HXTEMP," for time in times]


def work(*days: str, status: str = "") -> list[str]:
    return [f"{day},1,HX,REPLACED,,,{status}" for day in days]


def checks(*days: str) -> list[str]:
    return [f"AQX,LX-AAA,{day},C1" for day in days]


FIRST, SECOND = datetime(2041, 3, 4, tzinfo=UTC), datetime(2050, 1, 1, tzinfo=UTC)
DAYS = [f"{SECOND:%Y-%m-%d}", f"{FIRST:%Y-%m-%d}"]


@pytest.mark.parametrize(
    ("kind", "lines", "due_at"),
    [
        ("messages", messages(*(f"{day}T00:00:00Z" for day in DAYS)), FIRST),
        ("maintenance", work(*DAYS), FIRST),
        ("maintenance", work(*DAYS, status="PLANNED"), FIRST - FARTHEST),
        ("checks", checks(*DAYS), FIRST - FARTHEST),
    ],
    ids=["messages", "work", "planned work", "checks"],
)
def test_log_is_due_at_its_first_line_ahead(read, kind, lines, due_at):
    log = read(kind, *lines)

    assert (log.rows.height, log.due_at) == (0, due_at)


def test_log_without_lines_ahead_is_not_due(read):
    assert read("maintenance", *work("2024-05-03")).due_at is None


@pytest.mark.parametrize(("status", "n_rows"), [("", 0), ("DONE", 0), ("PLANNED", 1), ("CANCELLED", 1)])
def test_only_undone_work_lies_ahead(read, status, n_rows):
    assert read("maintenance", *work("2027-05-03", status=status)).rows.height == n_rows


@pytest.mark.parametrize(("day", "reasons"), [("2014-06-01", []), ("2014-05-31", ["before_delivery"])])
def test_work_may_be_of_the_day_of_delivery(read, day, reasons):
    assert read("maintenance", *work(day)).quarantine["reason"].to_list() == reasons


def test_note_names_the_first_five_days(read):
    log = read("maintenance", *work(*(f"2014-01-{day:02d}" for day in range(9, 1, -1))))

    (note,) = log.quarantine["detail"]
    assert note.endswith("work of 2014-01-02, 2014-01-03, 2014-01-04, 2014-01-05, 2014-01-06.")


@pytest.mark.parametrize(("day", "days"), [("1980-01-06", []), ("1980-01-07", [date(1980, 1, 7)])])
def test_check_before_any_clock_is_refused(read, day, days):
    assert read("checks", *checks(day)).rows["planned_on"].to_list() == days
