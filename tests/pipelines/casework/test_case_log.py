"""The log of cases: nothing is lost, changed or taken out, however many write at once."""

import multiprocessing
import sqlite3
from pathlib import Path

import polars as pl
import pytest
from databases import SERVER, new_database

from pipelines.storage.cases import FILE, CaseLog, ConflictError

ALERT = {"alert_id": "a1", "operator": "AAA", "tail": "T-1", "pack": 1, "component": "HX", "diagnosis": "HX_FOULING"}


def write(home: Path, person: str, n: int = 20) -> None:
    for k in range(n):
        CaseLog(home, "").append(ALERT | {"alert_id": f"a{k % 3}"}, "watch", person, {"note": f"{k} %s ? '"})


def test_three_writers_at_once_lose_nothing(tmp_path):
    people = ("Ada", "Bo", "Cy")
    context = multiprocessing.get_context("spawn")
    writers = [context.Process(target=write, args=(tmp_path, person)) for person in people]
    for w in writers:
        w.start()
    for w in writers:
        w.join(60)
    entries = CaseLog(tmp_path, "").entries()
    assert entries["line"].to_list() == list(range(1, 61))
    assert entries["at"].is_sorted()
    for person in people:
        assert entries.filter(person=person)["note"].to_list() == [f"{k} %s ? '" for k in range(20)]


def test_the_second_of_two_who_saw_the_same_is_told_who_was_first(tmp_path):
    log = CaseLog(tmp_path, "")
    line = log.append(ALERT, "acknowledge", "Ada", expected_line=0)
    log.append(ALERT | {"alert_id": "other"}, "acknowledge", "Bo", expected_line=0)
    log.append(ALERT, "assign", "Bo", {"assignee": "Cy"}, expected_line=line)
    with pytest.raises(ConflictError, match="Bo changed this case in the meantime"):
        log.append(ALERT, "mute", "Ada", {"until": "2030-01-01T00:00:00+00:00"}, expected_line=line)
    assert log.entries().filter(alert_id="a1")["kind"].to_list() == ["acknowledge", "assign"]


@pytest.mark.parametrize("line", [2, 10**17, -1])
def test_a_line_that_there_is_not_is_none_that_anybody_saw(tmp_path, line):
    log = CaseLog(tmp_path, "")
    with pytest.raises(ConflictError, match=f"line {line} of the log is none about this case"):
        log.append(ALERT, "acknowledge", "Ada", expected_line=line)
    assert log.last_line() == 0
    log.append(ALERT, "acknowledge", "Ada", expected_line=0)
    with pytest.raises(ConflictError):
        log.append(ALERT, "acknowledge", "Bo", expected_line=line)
    assert log.last_line() == 1


def test_no_line_is_ever_changed_or_taken_out(tmp_path):
    CaseLog(tmp_path, "").append(ALERT, "acknowledge", "Ada")
    with sqlite3.connect(tmp_path / FILE) as con:
        for sql in ("update cases set person = 'Eve'", "delete from cases"):
            with pytest.raises(sqlite3.IntegrityError, match="only added to"):
                con.execute(sql)
    con.close()
    assert CaseLog(tmp_path, "").entries()["person"].to_list() == ["Ada"]


def test_who_looks_writes_nothing(tmp_path):
    assert CaseLog(tmp_path, "").entries().is_empty()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("damage", ["gone", "damaged"])
def test_a_lost_log_is_put_back_from_what_the_nights_have_stored(tmp_path, damage):
    log = CaseLog(tmp_path, "")
    log.append(ALERT, "close", "Ada", {"finding": "FOULED", "done_on": "2024-06-19", "loss_then": 0.2})
    log.append(ALERT, "mute", "Bo", {"until": "2030-01-01T00:00:00+00:00", "note": "x"})
    stored = log.entries()
    assert log.repair(stored) is None
    if damage == "gone":
        (tmp_path / FILE).unlink()
    else:
        (tmp_path / FILE).write_bytes((tmp_path / FILE).read_bytes()[:3000])
    assert "2 lines are put back" in log.repair(stored)
    assert log.entries().equals(stored)
    assert log.append(ALERT, "watch", "Cy") == 3
    assert (tmp_path / f"{FILE}.damaged").exists() == (damage == "damaged")


def test_a_line_that_rots_is_put_back_and_a_new_one_stays(tmp_path):
    log = CaseLog(tmp_path, "")
    log.append(ALERT, "mute", "Bo", {"until": "2030-01-01T00:00:00+00:00", "note": "x"})
    stored = log.entries()
    log.append(ALERT, "watch", "Cy")
    content = (tmp_path / FILE).read_bytes()
    (tmp_path / FILE).write_bytes(content.replace(b"2030-01-01", b"2034-01-01"))
    assert log.fault(stored) == "holds a line that is not what was written"
    assert "1 lines are put back, and 1 since the last night" in log.repair(stored)
    assert log.fault(stored) is None
    assert log.entries()["person"].to_list() == ["Bo", "Cy"]
    assert log.entries().head(1).equals(stored)


@pytest.mark.skipif(not SERVER, reason="HDT_TEST_POSTGRES names no PostgreSQL server")
def test_a_database_keeps_it_for_several_machines():
    with new_database() as url:
        _of_two_machines(*(CaseLog(Path("/nowhere"), url) for _ in range(2)))


def _of_two_machines(one: CaseLog, two: CaseLog) -> None:
    line = one.append(ALERT, "close", "Ada", {"finding": "FOULED", "done_on": "2024-06-19", "note": "50 %"})
    with pytest.raises(ConflictError):
        two.append(ALERT, "acknowledge", "Bo", expected_line=0)
    two.append(ALERT, "acknowledge", "Bo", expected_line=line)
    entries = two.entries()
    assert entries.select("line", "kind", "note").rows() == [(1, "close", "50 %"), (2, "acknowledge", None)]
    assert entries.schema["done_on"] == pl.Date
