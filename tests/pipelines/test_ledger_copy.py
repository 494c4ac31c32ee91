"""The ledger's copy: what the last night left is noticed to be changed, and put back."""

from pathlib import Path

import polars as pl
import pytest

from pipelines.storage.ledger import Ledger
from pipelines.storage.ledger_copy import copy_ledger, find_ledger_fault, repair

CELL = pl.DataFrame({"operator": ["AQX"], "tail": ["LX-AAA"], "flight_id": ["f1"], "version": ["v1"]})


@pytest.fixture
def ledger(tmp_path, monkeypatch) -> Ledger:
    monkeypatch.delenv("HDT_LEDGER_URL", raising=False)
    ledger = Ledger(tmp_path)
    ledger.register([("a/1.csv", "AQX", "LX-AAA", "acms", 1, 1, "d1")], {"a/1.csv": ["f1"]})
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
def test_a_damaged_ledger_is_told_and_put_back(ledger, damage):
    assert find_ledger_fault(ledger) is None
    DAMAGE[damage](ledger.home / "ledger.sqlite")
    assert find_ledger_fault(ledger)
    assert "the copy of the last night's end" in str(repair(ledger))
    assert ledger.cells("raw_flights").equals(CELL)
    assert find_ledger_fault(ledger) is None
    assert repair(ledger) is None


def test_what_was_written_since_is_no_damage(ledger):
    ledger.mark("raw_flights", CELL.with_columns(version=pl.lit("v2")))
    assert find_ledger_fault(ledger) is None
    copy_ledger(ledger)
    assert len(list(ledger.home.glob("*.copy"))) == 1
    assert ledger.cells("raw_flights")["version"].to_list() == ["v2"]


def test_who_is_killed_at_the_copy_leaves_a_ledger_that_is_whole(ledger, monkeypatch):
    ledger.mark("raw_flights", CELL.with_columns(version=pl.lit("v2")))

    def killed(event: str, *_: object) -> None:
        if event.startswith("hdt."):
            raise RuntimeError(event)

    monkeypatch.setattr("sys.audit", killed)
    with pytest.raises(RuntimeError, match="before_write"):
        copy_ledger(ledger)
    monkeypatch.undo()
    assert find_ledger_fault(ledger) is None
    assert ledger.cells("raw_flights")["version"].to_list() == ["v2"]


def test_a_torn_ledger_is_put_back_as_it_was_though_written_since(ledger):
    ledger.mark("raw_flights", CELL.with_columns(version=pl.lit("v2")))
    ledger.flush()
    path = ledger.home / "ledger.sqlite"
    path.write_bytes(path.read_bytes()[:5000])
    assert repair(ledger)
    assert ledger.cells("raw_flights").equals(CELL)


def test_without_a_whole_copy_all_is_taken_in_again(ledger):
    for file in (*ledger.home.glob("*.copy"), ledger.home / "ledger.sqlite"):
        file.write_bytes(b"nothing")
    assert "taken in again" in str(repair(ledger))
    assert ledger.cells("raw_flights").is_empty()


def test_a_home_that_has_no_ledger_yet_lacks_none(tmp_path):
    assert find_ledger_fault(Ledger(tmp_path)) is None
    assert repair(Ledger(tmp_path)) is None
