"""A log of the last days, or an older one that comes again, takes out only what its own time lacks."""

from collections.abc import Callable
from itertools import permutations

import pytest

from pipelines.intake.kept_lines import keep_lines
from pipelines.intake.landing_file import FileIntake
from pipelines.intake.logs import read_maintenance, read_messages

READ = {"maintenance": read_maintenance, "messages": read_messages}
HEAD = {
    "maintenance": "done_on,pack,component,action,finding,reference,status\n",
    "messages": "message_time,flight_id,pack,code,text\n",
}
Deliver = Callable[..., FileIntake]


@pytest.fixture
def delivered(deliver, now) -> Deliver:
    """Deliver logs one after another, as a night each; what the last one stores."""

    def nights(*logs: list[str], kind: str = "maintenance") -> FileIntake:
        stored = None
        for lines in logs:
            text = HEAD[kind] + "".join(f"{line}\n" for line in lines)
            (file,) = deliver({f"AQX/LX-AAA/{kind}.csv": text.encode()})
            log = READ[kind](file, now)
            stored = keep_lines(file, log, log.rows.clear() if stored is None else stored.rows)
        return stored

    return nights


def work(day: str, reference: str = "", status: str = "", action: str = "CLEANED") -> str:
    on = day if day.startswith("2025") else f"2024-{day}"
    return f"{on},1,HX,{action},,{reference},{status}"


def days(log: FileIntake) -> list[str]:
    column = "done_on" if "done_on" in log.rows.columns else "message_time"
    return sorted(f"{time:%m-%d}" for time in log.rows[column])


YEAR = [work(f"{month:02}-03", f"WO{month}") for month in range(1, 6)]
MONTHS = [f"{month:02}-03" for month in range(1, 6)]


@pytest.mark.parametrize("short", [YEAR[3:], YEAR[:3], YEAR[1:3], []], ids=["last", "first", "amid", "none"])
def test_shorter_log_erases_nothing(delivered, short):
    assert days(delivered(YEAR, short)) == MONTHS


@pytest.mark.parametrize("order", list(permutations([YEAR[:2], YEAR[1:4], YEAR[3:]])))
def test_order_of_rolling_logs_is_free(delivered, order):
    assert days(delivered(*order)) == MONTHS


@pytest.mark.parametrize(
    "order", list(permutations([[work("01-31")], [work("02-02")], [work("02-28"), work("03-01")]]))
)
def test_months_one_by_one_are_all_kept(delivered, order):
    """Work without a reference, too."""
    assert days(delivered(*order)) == ["01-31", "02-02", "02-28", "03-01"]


def test_line_within_its_time_is_taken_out(delivered):
    assert days(delivered(YEAR, YEAR[::2])) == ["01-03", "03-03", "05-03"]


@pytest.mark.parametrize("short", [YEAR[:4], YEAR[2:4]], ids=["whole", "rolling"])
def test_last_work_can_be_taken_out(delivered, short):
    """Entered by mistake, and deleted."""
    assert days(delivered(YEAR, short)) == MONTHS[:4]


def test_plans_beyond_deleted_work_stay(delivered):
    plan = work("12-01", "WO12", "PLANNED")
    assert days(delivered([*YEAR, plan], [*YEAR[:4], plan])) == [*MONTHS[:4], "12-01"]


def test_log_with_news_deletes_nothing_after_it(delivered):
    """A log of earlier months that comes late."""
    assert days(delivered(YEAR[2:], [*YEAR[:2], *YEAR[2:4]])) == MONTHS


@pytest.mark.parametrize(
    ("before", "now_written"),
    [
        (work("05-20", "WO9"), work("05-02", "WO9")),
        (work("05-20"), work("05-18")),
        (work("05-20", "WO9"), work("05-20", "WO9", action="REPLACED")),
        (work("05-20"), work("05-20T14:20:00Z")),
        (work("05-20", "WO9", "PLANNED"), work("05-10", "WO9", "DONE")),
    ],
    ids=["reference", "days off", "action", "time of day", "status"],
)
def test_corrected_line_is_not_kept_besides(delivered, before, now_written):
    log = delivered([*YEAR[:3], before], [YEAR[2], now_written])

    assert log.rows.height == 4
    assert log.rows.filter(done_on=delivered([now_written]).rows["done_on"].item()).height == 1


FREQUENT = [work(f"01-{day:02}") for day in range(1, 30, 4)]


@pytest.mark.parametrize("order", list(permutations([FREQUENT[:4], FREQUENT[3:6], FREQUENT[5:]])))
def test_frequent_work_is_kept_in_any_order(delivered, order):
    """Every four days, without a reference, in logs that overlap."""
    assert len(days(delivered(*order))) == len(FREQUENT)


def test_only_a_few_days_make_work_the_same(delivered):
    """A wash months later, without a reference, is another wash."""
    assert days(delivered([work("01-05"), work("03-05")], [work("03-05"), work("05-05")])) == [
        "01-05",
        "03-05",
        "05-05",
    ]


@pytest.mark.parametrize(
    ("day", "n"),
    [("03-08", 2), ("03-09", 3), ("06-02", 2), ("06-03", 3), ("2025-02-05", 2), ("2025-02-06", 2), ("2025-02-07", 3)],
)
def test_mistaken_date_is_corrected(delivered, day, n):
    """Of 6 February: up to a month or a year off or exchanged, and not the next check of its name."""
    log = delivered([work("01-03"), work("02-06", "A-CHECK")], [work(day, "A-CHECK")])

    assert log.rows.height == n


def test_shared_reference_names_no_line(delivered):
    checks = [work("01-05", "A-CHECK"), work("03-05", "A-CHECK")]

    assert days(delivered(checks, [work("05-05", "A-CHECK")])) == ["01-05", "03-05", "05-05"]


@pytest.mark.parametrize("status", ["OPEN", "PLANNED"])
def test_open_orders_stretch_no_time(delivered, status):
    """An open order of January and a plan for June, in a log of April alone."""
    log = delivered(YEAR, [work("01-01", "OPEN1", status), YEAR[3], work("06-01", "PLAN1", status)])

    assert days(log) == sorted([*MONTHS, "01-01", "06-01"])


def test_plan_is_stored_once(delivered):
    plan = work("12-01", "WO12", "PLANNED")
    assert days(delivered([*YEAR, plan], [*YEAR, plan])) == [*MONTHS, "12-01"]


MESSAGES = [f"2024-05-02T{hour:02}:00:00Z,,1,21-52-HXTEMP," for hour in (6, 9, 12, 18)]


@pytest.mark.parametrize("order", list(permutations([MESSAGES[:2], MESSAGES[1:3], MESSAGES[3:]])))
def test_messages_are_kept_to_the_minute(delivered, order):
    assert delivered(*order, kind="messages").rows.height == 4


def test_message_of_a_flight_may_be_timed_anew(delivered):
    log = delivered(
        ["2024-05-01T06:00:00Z,,1,21-52-HXTEMP,", "2024-05-02T06:00:00Z,LX-AAA_20240502_01,1,21-52-HXTEMP,"],
        ["2024-05-02T04:00:00Z,LX-AAA_20240502_01,1,21-52-HXTEMP,"],
        kind="messages",
    )

    assert [f"{time:%d %H}" for time in sorted(log.rows["message_time"])] == ["01 06", "02 04"]


def test_note_counts_kept_lines(delivered):
    log = delivered(YEAR, YEAR[2:3])
    (note,) = log.quarantine.select("reason", "scope", "detail").rows()

    assert note[:2] == ("fewer_lines", "note")
    assert note[2].endswith("Kept: 4, of these 2 before 2024-03-03 and 2 after 2024-03-03.")
    assert (log.n_delivered, log.n_loaded) == (5, 5)


def test_log_read_again_is_the_same(delivered):
    once, twice = delivered(YEAR, YEAR[3:4]), delivered(YEAR, YEAR[3:4], YEAR[3:4])

    assert twice.rows.sort("done_on").equals(once.rows.sort("done_on"))
    assert twice.quarantine["detail"].to_list() == once.quarantine["detail"].to_list()


def test_whole_log_gets_no_note(delivered):
    assert delivered(YEAR[3:], YEAR).quarantine.is_empty()


def test_broken_log_leaves_all(delivered):
    log = delivered(YEAR, ["yesterday,1,HX,CLEANED,,,"])

    assert days(log) == MONTHS
    assert log.quarantine["reason"].to_list() == ["unreadable_time"]
