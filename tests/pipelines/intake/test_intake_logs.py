"""What people write: messages, work, the fleet list, planned checks, costs and findings; a fault named by its place."""

import datetime as dt
from collections.abc import Callable

import polars as pl
import pytest
from small_catalog import OWN

from hdt_core.alerts.answers import with_findings
from hdt_core.records.unit_index import date_entries
from hdt_core.tables import TABLES
from pipelines.intake.findings import DEFAULTS, NAME, CostError, case_files, costs_or_fault, read_costs
from pipelines.intake.landing import list_landing
from pipelines.intake.landing_file import FileIntake
from pipelines.intake.logs import is_done, or_stored, read_checks, read_fleet, read_maintenance, read_messages

MESSAGE = "message_time,flight_id,pack,code,text\n"
WORK = "done_on,pack,component,action,finding,reference\n"
AIRCRAFT = "operator,tail,msn,delivered_on,packs\n"
LOGS = [
    ("messages", MESSAGE + '2024-05-02T18:51:18Z,LX-AAA_20240502_03,1,21-52-HXTEMP,"HOT, HIGH"\n', None),
    ("messages", MESSAGE, None),
    ("maintenance", WORK.strip(), None),
    ("fleet", AIRCRAFT, "no_rows"),
    ("messages", MESSAGE + "yesterday,?,9,,\n", "unreadable_time"),
    ("messages", MESSAGE + "2061-05-02T18:51:18Z,,1,21-52-HXTEMP,\n", "future_time"),
    ("messages", MESSAGE + "2024-05-02T18:51:18Z,X,1,21-52-HXTEMP,\n", "bad_flight_id"),
    ("messages", MESSAGE + "2024-05-02T18:51:18Z,LX-AAB_20240502_03,1,21-52,\n", "flight_id_contradicts_path"),
    ("messages", MESSAGE + "2024-05-02T18:51:18Z,,9,21-52-HXTEMP,\n", "bad_pack"),
    ("messages", MESSAGE + "2024-05-02T18:51:18Z,,1,=cmd(),\n", "bad_code"),
    ("maintenance", WORK + "2024-05-03,3,HX,REPLACED,,\n", "bad_pack"),
    ("maintenance", WORK + "1900-01-01,1,HX,REPLACED,,\n", "too_early"),
    ("messages", MESSAGE + "1900-05-02T18:51:18Z,,1,21-52-HXTEMP,\n", "too_early"),
    ("messages", MESSAGE + "2024-05-02T18:51:18Z,,3,21-52-HXTEMP,\n", "bad_pack"),
    ("maintenance", WORK + "1999-01-01,1,HX,REPLACED,FOULED,WO1\n", None),
    ("maintenance", WORK + "2024-05-03,,RAM_DOOR,INSPECTED,,\n", None),
    ("maintenance", WORK + "2024-05-03,,HX,REPLACED,,\n", "no_pack"),
    ("messages", MESSAGE + "2024-05-02T18:51:18Z,,,21-52-HXTEMP,\n", "no_pack"),
    ("messages", MESSAGE + "2024-05-02T18:51:18Z,,,21-52-OTHER,\n", None),
    ("maintenance", WORK + "2024-05-03T14:20:00Z,1,HX,REPLACED,,\n", None),
    ("maintenance", WORK + "2024-05-03T14:20,1,HX,REPLACED,,\n", "time_without_zone"),
    ("maintenance", WORK + "2024-05-03 00:00:00,1,HX,REPLACED,,\n", None),
    ("messages", MESSAGE + "2024-05-02 00:00:00,,1,21-52-HXTEMP,\n", "time_without_zone"),
    ("maintenance", WORK + "2061-05-03T14:20:00Z,1,HX,REPLACED,,\n", "future_time"),
    ("maintenance", WORK + "03.05.2024,1,HX,REPLACED,,\n", "unreadable_time"),
    ("maintenance", WORK + "2061-05-03,1,HX,REPLACED,,\n", "future_time"),
    ("maintenance", WORK + "2024-05-03,1,WING,REPLACED,,\n", "bad_code"),
    ("maintenance", WORK + "2024-05-03,1,HX\n", "wrong_field_count"),
    ("maintenance", "when,what\n2024-01-01,changed something\n", "missing_columns"),
    ("maintenance", "", "empty_file"),
    ("fleet", AIRCRAFT + "AQX,LX-AAA,40000,2014-06-01,2\n", None),
    ("fleet", AIRCRAFT + "AQX,LX-AAA,40000,2014-06-01,2.0\n", None),
    ("fleet", AIRCRAFT + "AQX,LX-AAA,40000,2014-06-01 00:00:00,2\n", None),
    ("fleet", AIRCRAFT + "AQX,LX-AAA,40000,2014-06-01 06:00:00,2\n", "unreadable_time"),
    ("messages", MESSAGE + "2024-05-02T18:51:18Z,,1.0,21-52-HXTEMP,\n", None),
    ("messages", MESSAGE + "2024-05-02T18:51:18Z,,1.5,21-52-HXTEMP,\n", "bad_pack"),
    ("messages", MESSAGE + '2024-05-02T18:51:18Z,,1,21-52-HXTEMP,"HOT\nHIGH"\n', None),
    ("messages", MESSAGE + '2024-05-02T18:51:18Z,,1,21-52-HXTEMP,"HOT\n', "bad_quoting"),
    ("maintenance", WORK + "2024-05-03,1.0,HX,REPLACED,,\n", None),
    ("maintenance", WORK.strip() + ",status\n2025-05-03,1,HX,REPLACED,,,PLANNED\n", None),
    ("maintenance", WORK.strip() + ",status\n2025-05-03,1,HX,REPLACED,,,COMPLETE\n", "unknown_status"),
    ("maintenance", WORK.strip() + ",wo_status\n2025-05-03,1,HX,REPLACED,,,COMPLETE\n", "unknown_status"),
    ("maintenance", WORK.strip() + ",status\n2061-05-03,1,HX,REPLACED,,,DONE\n", "future_time"),
    ("fleet", AIRCRAFT + "AQX,../etc,40000,2014-06-01,2\n", "bad_key"),
    ("fleet", AIRCRAFT + "AQX,LX-AAA,1,2014-06-01,2\nAQX,LX-AAA,1,2015-06-01,2\n", "bad_key"),
    ("fleet", AIRCRAFT + "AQX,LX-AAA,40000,soon,2\n", "unreadable_time"),
    ("fleet", AIRCRAFT + "AQX,LX-AAA,40000,2014-06-01,many\n", "bad_pack"),
]  # fmt: skip


def test_reversed_dates_cost_their_row(deliver, now):
    good, reversed_dates = "AQX,LX-AAA,1,2024-05-02,2024-05-02\n", "AQX,LX-AAB,2,2024-05-02,2024-05-01\n"
    content = "operator,tail,msn,valid_from,valid_to\n" + reversed_dates + good

    fleet = read_fleet(deliver({"fleet.csv": content.encode()})[0], now)

    assert fleet.rows["tail"].to_list() == ["LX-AAA"]
    (fault,) = fleet.quarantine.select("file", "row", "column_name", "reason").rows()
    assert fault == ("fleet.csv", 2, "valid_from, valid_to", "ends_before_start")


@pytest.fixture
def read_work(deliver, now) -> Callable[[str], FileIntake]:
    """Read a log of work."""
    return lambda text: read_maintenance(deliver({"AQX/LX-AAA/maintenance.csv": text.encode()})[0], now)


def test_quoted_line_breaks_become_spaces(deliver, now):
    lines = '2024-05-02T18:51:18Z,,1,21-52-HXTEMP,"HOT,\n\nHIGH"\n2024-05-03T18:51:18Z,,2,21-52-HXTEMP,5" duct\n'

    log = read_messages(deliver({"AQX/LX-AAA/messages.csv": (MESSAGE + lines).encode()})[0], now)

    assert log.rows["text"].to_list() == ["HOT,  HIGH", '5" duct']


@pytest.mark.parametrize(("status", "done"), [("", 1), ("Closed", 1), ("CANCELLED", 0), ("deferred", 0)])
def test_status_decides_if_work_counts(status, done, read_work):
    rows = read_work(WORK.strip() + f",status\n2024-05-03,1,HX,REPLACED,,WO1,{status}\n").rows

    assert (rows.filter(is_done()).height, rows.height) == (done, 1)


@pytest.mark.parametrize("columns", ["wo_status", "task_status", "status,wo_status"])
def test_status_of_an_order_is_the_works(columns, read_work):
    """Of two columns the one that is filled in."""
    last = "," * columns.count(",") + "CANCELLED"
    rows = read_work(f"{WORK.strip()},{columns}\n2024-05-03,1,HX,REPLACED,,WO1,{last}\n").rows

    assert rows["status"].to_list() == ["CANCELLED"]


@pytest.mark.parametrize(("kind", "content", "reason"), LOGS, ids=[f"{k} {r} {i}" for i, (k, _, r) in enumerate(LOGS)])
def test_log_ends_as_expected(kind, content, reason, deliver, now):
    path = "fleet.csv" if kind == "fleet" else f"AQX/LX-AAA/{kind}.csv"
    read = {"messages": read_messages, "maintenance": read_maintenance, "fleet": read_fleet}[kind]
    log = read(deliver({path: content.encode()})[0], now)
    assert log.quarantine["reason"].to_list() == ([reason] if reason else [])
    assert log.n_delivered == log.rows.height + log.n_duplicate + log.quarantine["n_rows"].sum()


def test_repeated_work_counts_once(read_work):
    work = read_work(WORK + 3 * "2024-05-03,1,HX,REPLACED,FOULED,WO1\n")
    assert (work.rows.height, work.n_duplicate, work.n_delivered) == (1, 2, 3)


@pytest.mark.parametrize(
    ("written", "day", "time"),
    [
        ("2024-05-03", "2024-05-03", None),
        ("2024-05-04T00:30:00+02:00", "2024-05-03", "03 22:30"),
        ("2024-05-04T14:20:00Z", "2024-05-04", "04 14:20"),
        ("2024-05-04T00:00:01Z", "2024-05-04", "04 00:00"),
        ("2024-05-04 00:00:00", "2024-05-04", None),
        ("2024-05-04T00:00:00.000Z", "2024-05-04", None),
        ("2024-05-04T00:00+02:00", "2024-05-04", None),
        ("2024-05-04T02:00:00+02:00", "2024-05-04", "04 00:00"),
    ],
)
def test_work_has_day_or_time(read_work, written, day, time):
    (row,) = read_work(WORK + f"{written},1,HX,REPLACED,FOULED,WO1\n").rows.to_dicts()
    assert str(row["done_on"]) == day
    assert (row["done_at"] and f"{row['done_at']:%d %H:%M}") == time


def test_fleet_list_judges_work(deliver, now):
    """It says which packs there are, and since when."""
    fleet = b"operator,tail,packs,delivered_on\nAQX,LX-AAA,3,2014-06-01\n"
    content = WORK + "2024-05-03,3,HX,REPLACED,FOULED,WO1\n2013-05-03,1,HX,CLEANED,,WO2\n2024-05-04,4,HX,CLEANED,,WO3\n"
    files = deliver({"fleet.csv": fleet, "AQX/LX-AAA/maintenance.csv": content.encode()})
    log = read_maintenance(next(f for f in files if f.kind == "maintenance"), now)
    assert log.rows["pack"].to_list() == [1, 3]
    reasons = dict(log.quarantine.select("reason", "column_name").iter_rows())
    assert reasons == {"bad_pack": "pack", "before_delivery": "done_on"}
    assert "2013-05-03" in log.quarantine.filter(reason="before_delivery")["detail"].item()


@pytest.fixture
def stored(read_work) -> pl.DataFrame:
    """Rows that an earlier night stored."""
    return read_work(WORK + "2024-05-03,1,HX,REPLACED,,WO1\n").rows


def test_bad_log_leaves_stored_rows(read_work, stored):
    again = read_work(WORK + "2024-05-03,9,HX,REPLACED,,WO1\n")

    assert or_stored(again, stored).rows.equals(stored)


def test_good_line_replaces_stored_rows(read_work, stored):
    again = read_work(WORK + "2024-05-04,1,HX,REPLACED,,WO2\n")

    assert or_stored(again, stored).rows["reference"].to_list() == ["WO2"]


BEFORE_CHECKS = dt.datetime(2024, 6, 19, tzinfo=dt.UTC)
GOOD = [("AAA", "T-1", "2024-07-01", "A12"), ("AAA", "T-2", "2024-09-01", "C1")]
BAD = [("A", "T-1", "2024-07-01", "A12"), ("AAA", "T-1", "soon", "A12"), ("AAA", "T-1", "2099-01-01", "A12")]
CHECK_COLUMNS = ["operator", "tail", "date", "name"]


@pytest.fixture
def read_plan(tmp_path):
    """The planned checks of a landing zone in which `write` puts a file."""

    def read(name: str, write) -> FileIntake:
        (tmp_path / "fleet.csv").write_text("operator,tail\n")
        write(tmp_path / name)
        (file,) = [f for f in list_landing(tmp_path).files if f.kind == "checks"]
        return read_checks(file, BEFORE_CHECKS)

    return read


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_bad_checks_are_quarantined(read_plan, kind):
    frame = pl.DataFrame([*GOOD, *BAD], schema=CHECK_COLUMNS, orient="row")
    read = read_plan(f"checks.{kind}", getattr(frame, f"write_{kind}"))
    assert [(r[0], r[1], str(r[2]), r[3]) for r in read.rows.rows()] == GOOD
    first = 4 if kind == "csv" else 3
    assert read.quarantine.select("row", "column_name", "reason").rows() == [
        (first, "operator, tail", "bad_key"),
        (first + 1, "date", "unreadable_time"),
        (first + 2, "date", "unreadable_time"),
    ]
    assert read.n_delivered == 5 == read.n_loaded + read.quarantine["n_rows"].sum()


@pytest.mark.parametrize("dates", [[dt.date(2024, 7, 1), None], [dt.datetime(2024, 7, 1), dt.datetime(2024, 7, 2)]])
def test_parquet_plan_may_hold_dates(read_plan, dates):
    frame = pl.DataFrame({"operator": ["AAA"] * 2, "tail": ["T-1"] * 2, "date": dates})
    assert read_plan("checks.parquet", frame.write_parquet).rows["planned_on"][0] == dt.date(2024, 7, 1)


@pytest.mark.parametrize("content", [b"", b"PAR1", b"operator,tail,date\n", b"PAR1" + bytes(40) + b"PAR1"])
def test_broken_plan_gives_no_check(read_plan, content):
    read = read_plan("checks.parquet", lambda path: path.write_bytes(content))
    assert read.rows.is_empty()
    assert read.quarantine["reason"].to_list() == ["cannot_read_parquet"]


def test_costs_are_defaults_at_first(tmp_path):
    costs = read_costs(tmp_path)
    assert set(costs["source"]) == {"default"}
    assert costs.filter(component="HX", item="wash")["cost"].item() == DEFAULTS["HX"]["wash"]


def test_home_costs_replace_defaults(tmp_path):
    (tmp_path / NAME).write_text('currency = "EUR"\nhorizon_days = 14\n[HX]\nwash = 1234.5\n')
    costs = read_costs(tmp_path)
    assert costs.select("currency", "horizon_days").unique().rows() == [("EUR", 14)]
    assert costs.filter(component="HX", item="wash").select("cost", "source").rows() == [(1234.5, NAME)]
    assert costs.filter(component="HX", item="replace")["source"].item() == "default"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[HX]\nwash = -1\n", r"costs\.toml: HX\.wash: is a number from 0 to 1e\+12, not -1"),
        ('[HX]\nwash = "cheap"\n', r"costs\.toml: HX\.wash: is a number from 0 to 1e\+12, not 'cheap'"),
        ("[HX]\npolish = 1\n", r"costs\.toml: HX\.polish: means nothing; there are wash, replace"),
        ("[WING]\nwash = 1\n", r"costs\.toml: WING: is no table of a component"),
        ("HX = 3\n", r"costs\.toml: HX: is no table"),
        ("horizon_days = 0\n", r"costs\.toml: horizon_days: is a whole number of days"),
        ("currency = 3\n", r"costs\.toml: currency"),
        ("[HX\n", r"costs\.toml: can't be read"),
    ],
)
def test_bad_cost_is_named(tmp_path, text, message):
    """With file and key; and no other cost counts."""
    (tmp_path / NAME).write_text(text)
    with pytest.raises(CostError, match=message):
        read_costs(tmp_path)
    costs, (fault,) = costs_or_fault(tmp_path)
    assert (costs.height, fault.reason) == (0, "bad_cost")


DAY = dt.date(2024, 6, 19)


def log(**line: object) -> pl.DataFrame:
    entry = {"done_on": DAY, "component": "HX", "action": "INSPECTED", "finding": "NO_FAULT_FOUND", "reference": "WO1"}
    return TABLES["raw_maintenance"].schema.conform(pl.DataFrame([OWN | entry | line], infer_schema_length=None))


def case(line: int = 1, kind: str = "close", **values: object) -> dict:
    at = dt.datetime(2024, 6, 19, 5, tzinfo=dt.UTC)
    about = {"line": line, "at": at, "alert_id": "a1", "component": "HX", "diagnosis": "HX_FOULING", "kind": kind}
    answer = {"finding": "NO_FAULT_FOUND", "action": "INSPECTED", "done_on": DAY} if kind == "close" else {}
    return OWN | about | {"person": "Ada"} | answer | values


def cases(*rows: dict) -> pl.DataFrame:
    return TABLES["raw_cases"].schema.conform(pl.DataFrame(list(rows), infer_schema_length=None))


def test_case_equals_line_of_log():
    columns = ("operator", "tail", "pack", "component", "action", "finding", "done_on", "counts_from")
    by_log = date_entries(with_findings(log(), cases(case()).clear()))
    by_case = date_entries(with_findings(log().clear(), cases(case())))
    assert by_log.select(columns).equals(by_case.select(columns))
    assert (by_log["source"].item(), by_case["source"].item()) == ("log", "case")
    assert by_case["closes_alert_id"].item() == "a1"


def test_work_in_both_counts_once():
    finding = case(action="REPLACED", finding="FOULED", done_on=DAY - dt.timedelta(days=2))
    (row,) = with_findings(log(action="REPLACED", finding=None), cases(finding)).to_dicts()
    assert (row["done_on"], row["finding"], row["reference"], row["closes_alert_id"]) == (DAY, "FOULED", "WO1", "a1")


@pytest.mark.parametrize("line", [{"action": "CLEANED"}, {"action": "REPLACED", "done_on": DAY + dt.timedelta(days=9)}])
def test_other_work_stays_apart(line):
    finding = case(action="REPLACED", finding="FOULED", done_on=DAY - dt.timedelta(days=2))
    assert with_findings(log(**line), cases(finding)).height == 2


def test_last_answer_counts():
    again = case(2, finding="FOULED", action="CLEANED")
    assert with_findings(log().clear(), cases(case(), again))["finding"].to_list() == ["FOULED"]


def test_reopened_case_has_no_finding():
    assert with_findings(log().clear(), cases(case(), case(2, "reopen"))).is_empty()


def digests(*rows: dict) -> dict[str, str]:
    """Digests of the cases and of their findings."""
    return {kind: digest for _, _, _, kind, _, _, digest in case_files(cases(*rows))}


def test_acknowledgement_is_no_finding():
    assert set(digests(case(kind="acknowledge"))) == {"cases"}


def test_only_findings_renew_the_twin():
    """What changes the cases alone is on record without a night that makes the twin again."""
    before = digests(case(kind="acknowledge"), case(2))
    more = digests(case(kind="acknowledge"), case(2), case(3, "watch"))
    reopened = digests(case(), case(2), case(3, "reopen"))
    assert before["findings"] == more["findings"] != reopened["findings"]
    assert before["cases"] != more["cases"]
