"""What people do about alerts: their log, of which nothing is lost, seen at once, and through a night."""

import datetime as dt
import multiprocessing
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import polars as pl
import pytest
from answers import query
from case_homes import case_home, publish_losses
from databases import SERVER, new_database
from nights import run
from small_catalog import START

from hdt_core.loading import UserError
from pipelines.casework import RefusedError, change_case, find_case, history_of, list_cases
from pipelines.storage.cases import FILE, CaseLog, ConflictError
from pipelines.storage.ledger import Ledger

SOON = (dt.datetime.now(dt.UTC) + dt.timedelta(days=5)).date().isoformat()


@pytest.fixture(scope="module")
def template_home(tmp_path_factory) -> Path:
    return case_home(tmp_path_factory.mktemp("cases") / "home")


@pytest.fixture
def home(template_home: Path, tmp_path: Path) -> Path:
    """Two open alerts of one pack and a closed one."""
    return Path(shutil.copytree(template_home, tmp_path / "home"))


def change(home: Path, alert_id: str, *what: object, **fields: object) -> str:
    return change_case(home, find_case(home, alert_id), *what, **fields)


def state(home: Path, alert_id: str = "wear") -> str:
    return str(find_case(home, alert_id)["state"])


def history(home: Path, alert_id: str = "wear") -> list[dict]:
    return history_of(home, find_case(home, alert_id))


def test_open_alerts_are_new_cases(home):
    states = {"wear": "new", "clog": "new", "gone": "closed", "other": "new"}
    assert {c["alert_id"]: c["state"] for c in list_cases(home, "true")} == states


def test_change_shows_at_once(home):
    change(home, "wear", "acknowledge", "Ada")
    assert state(home) == "acknowledged"
    change(home, "wear", "assign", "Ada", assignee="Bo")
    change(home, "wear", "watch", "Cy")
    change(home, "wear", "watch", "Di")
    change(home, "wear", "unwatch", "Di")
    case = find_case(home, "wear")
    assert [case[c] for c in ("owner", "acknowledged_by", "watched_by", "last_by")] == ["Bo", "Ada", "Cy", "Di"]
    assert [h["kind"] for h in history(home)] == ["acknowledge", "assign", "watch", "watch", "unwatch"]


def test_muted_case_returns_when_worse(home):
    change(home, "wear", "mute", "Ada", until=SOON, note="parts on order")
    assert state(home) == "muted"
    for more, now in ((0.06, "worsened"), (0.04, "muted")):
        assert state(publish_losses(home, 0.2 + more)) == now
    change(home, "wear", "reopen", "Ada", note="parts came")
    assert state(home) == "new"


@pytest.mark.parametrize(
    ("finding", "action", "state_is", "message"),
    [
        ("clean", None, "closed", "raised as a sensor case"),
        ("fouled", "inspected", "confirmed", "stays open"),
        ("fouled", "cleaned", "closed", "estimates the part anew"),
    ],
)
def test_finding_answers_the_case(home, finding, action, state_is, message):
    day = START.date() + dt.timedelta(days=40)
    reply = change(home, "wear", "close", "Ada", finding=finding, action=action, on=str(day), note="ram face clean")
    assert message in reply
    case = find_case(home, "wear")
    assert (case["state"], case["found_by"], case["found_on"]) == (state_is, "Ada", day)
    change(home, "wear", "reopen", "Bo", note="wrong pack")
    assert state(home) == "new"


@pytest.mark.parametrize(
    ("component", "finding", "code", "note"),
    [
        ("SENSOR", "wiring fault", "DAMAGED", "wiring fault; left connector"),
        ("SENSOR", "reads correctly", "NO_FAULT_FOUND", "reads correctly; left connector"),
        ("RAM_DOOR", "jammed", "DAMAGED", "jammed; left connector"),
        ("CC", "eroded", "DAMAGED", "eroded; left connector"),
        ("PUMP", "worn", "DAMAGED", "worn; left connector"),
        ("SENSOR", "clean", "NO_FAULT_FOUND", "left connector"),
    ],
)
def test_each_component_has_own_findings(home, component, finding, code, note):
    case = find_case(home, "wear") | {"component": component}
    change_case(home, case, "close", "Ada", finding=finding, note="left connector")
    assert [(h["finding"], h["note"]) for h in history(home)] == [(code, note)]


@pytest.mark.parametrize(
    ("kind", "fields", "message"),
    [
        ("close", {"finding": "rusty"}, "finding is clean, fouled"),
        ("close", {"finding": "jammed"}, "finding is clean, fouled"),
        ("close", {"finding": "clean", "action": "polished"}, "action is inspected"),
        ("close", {"finding": "clean", "on": "2020-01-01"}, "when it was raised"),
        ("close", {"finding": "clean", "on": "2199-01-01"}, "to today"),
        ("close", {"finding": "clean", "on": "soon"}, "on is a day"),
        ("mute", {"until": SOON}, "needs a note"),
        ("mute", {"until": "2020-01-01", "note": "x"}, "until is a day within"),
        ("mute", {"until": "9999-12-31", "note": "x"}, "until is a day"),
        ("mute", {"until": "0001-01-01T00:00+14:00", "note": "x"}, "until is a day"),
        ("close", {"finding": "clean", "on": "9999-12-31"}, "on is a day"),
        ("close", {"finding": "clean", "on": "9999-12-31T23:59-14:00"}, "on is a day"),
        ("assign", {"assignee": " "}, "to is a person's name"),
        ("assign", {"assignee": "x" * 81}, "to is a person's name"),
        ("acknowledge", {"note": "x" * 1001}, "the limit is 1000"),
        ("reopen", {"note": "x"}, "nothing to take back"),
    ],
)
def test_senseless_change_leaves_no_line(home, kind, fields, message):
    with pytest.raises(RefusedError, match=message):
        change(home, "wear", kind, "Ada", **fields)
    assert history(home) == []


def test_closed_alert_takes_no_change(home):
    with pytest.raises(RefusedError, match="closed on"):
        change(home, "gone", "acknowledge", "Ada")


def test_long_closed_alert_takes_no_new_work(home):
    with pytest.raises(RefusedError, match=r"counts for (wear and clog|clog and wear), open now"):
        change(home, "gone", "close", "Ada", finding="fouled", action="cleaned")
    assert (state(home, "wear"), history(home, "gone")) == ("new", [])


def test_long_closed_alert_takes_work_of_its_time(home):
    own_day = START.date() + dt.timedelta(days=19)
    change(home, "gone", "close", "Ada", finding="fouled", action="cleaned", on=str(own_day))
    assert (state(home, "wear"), find_case(home, "gone")["found_on"]) == ("new", own_day)


def closed_beside_an_open_alert(home: Path, finding: str | None) -> dict:
    """The alert `wear`, closed five days after `clog` was raised."""
    return find_case(home, "wear") | {"closed_at": START + dt.timedelta(days=55), "finding": finding}


def test_own_closing_is_corrected(home):
    case = closed_beside_an_open_alert(home, "NO_FAULT_FOUND")
    assert "fouled, inspected" in change_case(home, case, "close", "Ada", finding="fouled")


def test_alert_closed_by_flights_takes_no_later_work(home):
    with pytest.raises(RefusedError, match="clog, open now"):
        change_case(home, closed_beside_an_open_alert(home, None), "close", "Ada", finding="fouled")


@pytest.mark.parametrize("name", ["", "x", "%", "_"])
def test_vague_name_finds_no_case(template_home, name):
    with pytest.raises(UserError):
        find_case(template_home, name)


ALERT = {"alert_id": "a1", "operator": "AAA", "tail": "T-1", "pack": 1, "component": "HX", "diagnosis": "HX_FOULING"}


def write(home: Path, person: str, n: int = 20) -> None:
    for k in range(n):
        CaseLog(home, "").append(ALERT | {"alert_id": f"a{k % 3}"}, "watch", person, {"note": f"{k} %s ? '"})


@pytest.fixture
def log(tmp_path) -> CaseLog:
    return CaseLog(tmp_path, "")


UNTIL_2030 = {"until": "2030-01-01T00:00:00+00:00", "note": "x"}


def test_three_writers_lose_nothing(tmp_path, log):
    people = ("Ada", "Bo", "Cy")
    context = multiprocessing.get_context("spawn")
    writers = [context.Process(target=write, args=(tmp_path, person)) for person in people]
    for w in writers:
        w.start()
    for w in writers:
        w.join(60)
    entries = log.entries()
    assert entries["line"].to_list() == list(range(1, 61))
    assert entries["at"].is_sorted()
    for person in people:
        assert entries.filter(person=person)["note"].to_list() == [f"{k} %s ? '" for k in range(20)]


def test_late_writer_learns_of_first(log):
    line = log.append(ALERT, "acknowledge", "Ada", expected_line=0)
    log.append(ALERT | {"alert_id": "other"}, "acknowledge", "Bo", expected_line=0)
    log.append(ALERT, "assign", "Bo", {"assignee": "Cy"}, expected_line=line)
    with pytest.raises(ConflictError, match="Bo changed this case in the meantime"):
        log.append(ALERT, "mute", "Ada", UNTIL_2030, expected_line=line)
    assert log.entries().filter(alert_id="a1")["kind"].to_list() == ["acknowledge", "assign"]


@pytest.mark.parametrize("line", [2, 10**17, -1])
def test_unknown_line_is_refused(log, line):
    with pytest.raises(ConflictError, match=f"line {line} of the log is none about this case"):
        log.append(ALERT, "acknowledge", "Ada", expected_line=line)
    assert log.entries().height == 0
    log.append(ALERT, "acknowledge", "Ada", expected_line=0)
    with pytest.raises(ConflictError):
        log.append(ALERT, "acknowledge", "Bo", expected_line=line)
    assert log.entries().height == 1


def test_reading_makes_no_log(tmp_path, log):
    assert log.entries().is_empty()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("sql", ["update cases set person = 'Eve'", "delete from cases"])
def test_log_only_grows(tmp_path, log, sql):
    log.append(ALERT, "acknowledge", "Ada")
    with (
        closing(sqlite3.connect(tmp_path / FILE)) as con,
        pytest.raises(sqlite3.IntegrityError, match="only added to"),
    ):
        con.execute(sql)
    assert log.entries()["person"].to_list() == ["Ada"]


@pytest.mark.parametrize("damage", ["gone", "damaged"])
def test_lost_log_is_restored(tmp_path, log, damage):
    log.append(ALERT, "close", "Ada", {"finding": "FOULED", "done_on": "2024-06-19", "loss_then": 0.2})
    log.append(ALERT, "mute", "Bo", UNTIL_2030)
    stored = log.entries()
    assert log.repair(stored) is None
    content = (tmp_path / FILE).read_bytes()
    (tmp_path / FILE).unlink() if damage == "gone" else (tmp_path / FILE).write_bytes(content[:3000])
    assert "2 lines are put back" in log.repair(stored)
    assert log.entries().equals(stored)
    assert log.append(ALERT, "watch", "Cy") == 3
    assert (tmp_path / f"{FILE}.damaged").exists() == (damage == "damaged")


def test_rotten_line_is_restored(tmp_path, log):
    """A line written since stays."""
    log.append(ALERT, "mute", "Bo", UNTIL_2030)
    stored = log.entries()
    log.append(ALERT, "watch", "Cy")
    content = (tmp_path / FILE).read_bytes()
    (tmp_path / FILE).write_bytes(content.replace(b"2030-01-01", b"2034-01-01"))
    assert log.fault(stored) == "holds a line that is not what was written"
    assert "1 lines are put back, and 1 since the last night" in log.repair(stored)
    assert log.fault(stored) is None
    assert log.entries()["person"].to_list() == ["Bo", "Cy"]
    assert log.entries().head(1).equals(stored)


def test_older_copy_regains_last_lines(tmp_path, log):
    log.append(ALERT, "acknowledge", "Ada")
    backup = (tmp_path / FILE).read_bytes()
    log.append(ALERT, "assign", "Ada", {"assignee": "Bo"})
    stored = log.entries()
    (tmp_path / FILE).write_bytes(backup)
    log.append(ALERT, "mute", "Cy", UNTIL_2030)
    assert "lacks 1 lines that the tables hold; 1 lines are put back" in str(log.repair(stored))
    assert log.entries().select("line", "kind").rows() == [(1, "acknowledge"), (2, "assign"), (3, "mute")]
    assert log.repair(stored) is None


def test_lines_without_ids_join_once(tmp_path, log):
    """As those from before there were ids."""
    log.append(ALERT, "assign", "Ada", {"assignee": "Bo"})
    with closing(sqlite3.connect(tmp_path / FILE)) as con, con:
        con.execute("drop trigger no_update")
        con.execute("update cases set body = json_remove(body, '$.id', '$.case_id')")
    stored = log.entries().with_columns(id=pl.lit(None, pl.String), case_id=pl.lit(None, pl.String))
    log.append(ALERT, "watch", "Cy")
    assert log.repair(stored) is None
    (tmp_path / FILE).unlink()
    assert "1 lines are put back" in str(log.repair(stored))
    assert log.entries().select("case_id", "kind").rows() == [("a1", "assign")]


@pytest.mark.skipif(not SERVER, reason="HDT_TEST_POSTGRES names no PostgreSQL server")
def test_database_serves_several_machines():
    with new_database() as url:
        one, two = (CaseLog(Path("/nowhere"), url) for _ in range(2))
        line = one.append(ALERT, "close", "Ada", {"finding": "FOULED", "done_on": "2024-06-19", "note": "50 %"})
        with pytest.raises(ConflictError):
            two.append(ALERT, "acknowledge", "Bo", expected_line=0)
        two.append(ALERT, "acknowledge", "Bo", expected_line=line)
        entries = two.entries()
        missing = entries.with_columns(id=pl.lit("missing"), at=pl.col("at").dt.offset_by("-1d")).head(1)
        assert "lacks 1 lines" in str(one.repair(pl.concat([entries, missing])))
        assert two.entries()["id"].to_list() == ["missing", *entries["id"]]
    assert entries.select("line", "kind", "note").rows() == [(1, "close", "50 %"), (2, "acknowledge", None)]
    assert entries.schema["done_on"] == pl.Date


def test_clean_finding_becomes_sensor_case(own_home):
    landing, home = own_home
    (case,) = list_cases(home, "c.diagnosis = 'HX_FOULING' and c.closed_at is null and c.tail = 'A9-BAC'")
    change_case(home, case, "close", "Ada", finding="clean", on="2024-06-19", note="core face clean")
    assert find_case(home, case["alert_id"])["state"] == "closed"
    health = Ledger(home).cells("twin_health")
    night = run(landing, home)
    assert not night.failed
    assert night.new_files == 0
    remade = Ledger(home).cells("twin_health").join(health, on=health.columns, how="anti")
    assert remade["tail"].to_list() == ["A9-BAC"], "and no other aircraft is made again"
    outcomes = f"""select closed_on::varchar, closed_reason, outcome from alerts join alert_outcomes using (alert_id)
        where alert_id = '{case["alert_id"]}'"""
    after = f"select diagnosis, closed_at from alerts where follows = '{case['alert_id']}'"
    status = """select distinct status from prognoses where tail = 'A9-BAC' and pack = 2 and component = 'HX'
        and departed_on > '2024-06-20'"""
    assert query(home, outcomes) == [("2024-06-20", "found_clean", "no_fault_found")]
    assert query(home, after) == [("SENSOR_FAULT", None)], "the loss grew from 16 to 21 % after it"
    assert query(home, status) == [("contradicted",)]
    assert query(home, "select person, note from tables.raw_cases") == [("Ada", "core face clean")]
    assert find_case(home, case["alert_id"])["state"] == "closed"
    assert run(landing, home).idle
    change_case(home, case, "watch", "Bo")
    assert run(landing, home).cells == 1, "a word alone makes nothing anew but its own table"
