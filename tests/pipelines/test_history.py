"""A night reads of Dagster's history the files that all runs share; `hdt doctor` reads all."""

import sqlite3
from contextlib import closing

import pytest

from pipelines.storage.history import find_history_fault, replace_damaged_history

RUN = "0217790e-c4e7-410f-905d-2e60707d3890"


@pytest.fixture
def home(tmp_path):
    (tmp_path / "dagster" / "history").mkdir(parents=True)
    for name in ("index", "runs", RUN):
        with closing(sqlite3.connect(file_of(tmp_path, name))) as con, con:
            con.execute("create table events as select 1 as id")
    return tmp_path


def file_of(home, name):
    return home / "dagster" / "history" / f"{name}.db"


def damage(home, name):
    content = bytearray(file_of(home, name).read_bytes())
    content[:16] = b"no SQLite at all"
    file_of(home, name).write_bytes(content)


@pytest.mark.parametrize("name", ["index", "runs"])
def test_a_damaged_file_is_told_and_a_new_history_begins(home, name):
    assert replace_damaged_history(home, whole=False) is None
    damage(home, name)
    assert replace_damaged_history(home, whole=False).startswith(
        f"dagster/history/{name}.db is damaged (file is not a database); "
    )
    assert not (home / "dagster").exists()
    assert replace_damaged_history(home, whole=False) is None


def test_the_file_of_a_run_that_rots_is_found_by_the_doctor(home):
    damage(home, RUN)
    assert replace_damaged_history(home, whole=False) is None
    assert f"{RUN}.db is damaged" in find_history_fault(home)
    assert f"{RUN}.db is damaged" in replace_damaged_history(home)
