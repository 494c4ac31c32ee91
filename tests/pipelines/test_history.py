"""A night reads of Dagster's history what has changed since one found it sound; `hdt doctor` reads all."""

import os
import sqlite3
from contextlib import closing

import pytest

from pipelines.storage import history
from pipelines.storage.history import find_history_fault, replace_damaged_history

RUNS = [f"run{n}" for n in range(3)]


@pytest.fixture
def home(tmp_path):
    (tmp_path / "dagster" / "history").mkdir(parents=True)
    for run in RUNS:
        write(tmp_path, run, "create table events as select 1 as id")
    return tmp_path


def file_of(home, run):
    return home / "dagster" / "history" / f"{run}.db"


def write(home, run, sql):
    with closing(sqlite3.connect(file_of(home, run))) as con, con:
        con.execute(sql)


def damage(home, run):
    content = bytearray(file_of(home, run).read_bytes())
    content[:16] = b"no SQLite at all"
    file_of(home, run).write_bytes(content)


def test_a_night_reads_a_file_once_and_again_when_it_has_changed(home, monkeypatch):
    read, query_value = [], history.query_value
    monkeypatch.setattr(history, "query_value", lambda file, sql: read.append(file.stem) or query_value(file, sql))
    assert replace_damaged_history(home, whole=False) is None
    assert read == RUNS
    read.clear()
    assert replace_damaged_history(home, whole=False) is None
    assert read == []
    write(home, "run1", "insert into events values (2)")
    assert replace_damaged_history(home, whole=False) is None
    assert read == ["run1"]


@pytest.mark.parametrize("noted", [False, True])
def test_a_damaged_file_is_told_and_a_new_history_begins(home, noted):
    if noted:
        replace_damaged_history(home, whole=False)
    damage(home, "run2")
    assert replace_damaged_history(home, whole=False).startswith(
        "dagster/history/run2.db is damaged (file is not a database); "
    )
    assert not (home / "dagster").exists()
    assert replace_damaged_history(home, whole=False) is None


def test_what_rots_on_the_disk_is_found_by_the_doctor(home):
    replace_damaged_history(home, whole=False)
    before = file_of(home, "run0").stat()
    damage(home, "run0")
    os.utime(file_of(home, "run0"), ns=(before.st_atime_ns, before.st_mtime_ns))
    assert replace_damaged_history(home, whole=False) is None
    assert "run0.db is damaged" in find_history_fault(home)
    assert "run0.db is damaged" in replace_damaged_history(home)


def test_a_note_that_is_nonsense_costs_a_second_reading_and_nothing_else(home):
    (home / "dagster" / "sound.txt").write_bytes(b"\xff\x00 nonsense")
    assert replace_damaged_history(home, whole=False) is None
    damage(home, "run0")
    assert replace_damaged_history(home, whole=False)
