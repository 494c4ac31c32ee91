"""What the last night left is damaged: the ledger is put back from its copy, Dagster's history begun anew."""

import sqlite3
from contextlib import closing
from pathlib import Path

import polars as pl
import pytest

from pipelines.repair import find_history_fault, replace_damaged_history
from pipelines.storage.ledger import Ledger
from pipelines.storage.ledger_copy import copy_ledger, find_ledger_fault, repair_ledger

CELL = pl.DataFrame({"operator": ["AQX"], "tail": ["LX-AAA"], "flight_id": ["f1"], "version": ["v1"]})


@pytest.fixture
def ledger(tmp_path, monkeypatch) -> Ledger:
    monkeypatch.delenv("HDT_LEDGER_URL", raising=False)
    ledger = Ledger(tmp_path)
    ledger.register([("a/1.csv", "AQX", "LX-AAA", "acms", 1, 1, "d1")], {"a/1.csv": [("AQX", "LX-AAA", "f1")]})
    ledger.mark("raw_flights", CELL)
    copy_ledger(ledger)
    return ledger


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[content.index(b"LX-AAA")] ^= 1
    path.write_bytes(content)


DAMAGE = {
    "gone": Path.unlink,
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("no database\n" * 100),
    "flipped": flip,
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_ledger_is_restored(ledger, damage):
    assert find_ledger_fault(ledger) is None
    DAMAGE[damage](ledger.home / "ledger.sqlite")
    assert find_ledger_fault(ledger)
    assert "the copy of the last night's end" in str(repair_ledger(ledger))
    assert ledger.cells("raw_flights").equals(CELL)
    assert find_ledger_fault(ledger) is None
    assert repair_ledger(ledger) is None


def mark_anew(ledger: Ledger) -> None:
    ledger.mark("raw_flights", CELL.with_columns(version=pl.lit("v2")))


def test_later_lines_are_no_damage(ledger):
    mark_anew(ledger)
    assert find_ledger_fault(ledger) is None
    copy_ledger(ledger)
    assert len(list(ledger.home.glob("*.copy"))) == 1
    assert ledger.cells("raw_flights")["version"].to_list() == ["v2"]


def test_killed_copy_leaves_whole_ledger(ledger, monkeypatch):
    mark_anew(ledger)

    def killed(event: str, *_: object) -> None:
        if event.startswith("hdt."):
            raise RuntimeError(event)

    monkeypatch.setattr("sys.audit", killed)
    with pytest.raises(RuntimeError, match="before_write"):
        copy_ledger(ledger)
    monkeypatch.undo()
    assert find_ledger_fault(ledger) is None
    assert ledger.cells("raw_flights")["version"].to_list() == ["v2"]


def test_torn_ledger_is_restored(ledger):
    """As it was at the night's end."""
    mark_anew(ledger)
    ledger.flush()
    path = ledger.home / "ledger.sqlite"
    path.write_bytes(path.read_bytes()[:5000])
    assert repair_ledger(ledger)
    assert ledger.cells("raw_flights").equals(CELL)


def test_ledger_without_copy_begins_anew(ledger):
    for file in (*ledger.home.glob("*.copy"), ledger.home / "ledger.sqlite"):
        file.write_bytes(b"nothing")
    assert "taken in again" in str(repair_ledger(ledger))
    assert ledger.cells("raw_flights").is_empty()


def test_new_home_lacks_no_ledger(tmp_path):
    assert find_ledger_fault(Ledger(tmp_path)) is None
    assert repair_ledger(Ledger(tmp_path)) is None


RUN = "0217790e-c4e7-410f-905d-2e60707d3890"


@pytest.fixture
def history_home(tmp_path):
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
def test_damaged_history_begins_anew(history_home, name):
    assert replace_damaged_history(history_home, whole=False) is None
    damage(history_home, name)
    assert replace_damaged_history(history_home, whole=False).startswith(
        f"dagster/history/{name}.db is damaged (file is not a database); "
    )
    assert not (history_home / "dagster").exists()
    assert replace_damaged_history(history_home, whole=False) is None


def test_doctor_finds_rotten_run(history_home):
    damage(history_home, RUN)
    assert replace_damaged_history(history_home, whole=False) is None
    assert f"{RUN}.db is damaged" in find_history_fault(history_home)
    assert f"{RUN}.db is damaged" in replace_damaged_history(history_home)
