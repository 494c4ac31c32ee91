"""What a flight is built from again: folders of its files, packs and quarantine that are stored of them."""

import polars as pl
import pytest

from hdt_core.tables import TABLES
from pipelines.intake.faults import BREAKS_DECLARATION
from pipelines.intake.ingest import StoredRows, folder_of


class Stored(StoredRows):
    """Tables of one flight in memory."""

    tables: dict[str, list[dict]]

    def _read(self, table: str) -> pl.DataFrame:
        rows = self.tables.get(table, [])
        return TABLES[table].conform(pl.DataFrame(rows)) if rows else TABLES[table].schema.create_empty()


@pytest.fixture
def stored(monkeypatch):
    """Rows of files, of which a.csv and b.csv are in the landing zone."""

    def make(**tables: list[dict]) -> StoredRows:
        monkeypatch.setattr(Stored, "tables", tables, raising=False)
        return Stored(None, ("AQX", "LX-AAA"), [], ["a.csv", "b.csv"], [])

    return make


def reports(file: str, **n_of_pack: int) -> list[dict]:
    """Reports of a file: so many of each pack."""
    key = {"operator": "AQX", "tail": "LX-AAA", "flight_id": "LX-AAA_20240525_04", "source": "acms", "file": file}
    return [key | {"pack": int(name[1:])} for name, n in n_of_pack.items() for _ in range(n)]


@pytest.mark.parametrize(("n_odd", "highest"), [(1, 2), (2, 3)])
def test_few_odd_rows_make_no_pack(stored, n_odd, highest):
    """Fewer than a tenth of the file's fullest pack."""
    rows = reports("a.csv", p1=20, p2=20, p3=n_odd)

    assert stored(raw_snapshots=rows).packs() == {"a.csv": highest}


def test_packs_are_counted_by_file(stored):
    rows = reports("a.csv", p1=20, p2=20) + reports("b.csv", p1=1) + reports("removed.csv", p1=9, p2=9, p3=9)

    assert stored(raw_snapshots=rows).packs() == {"a.csv": 2, "b.csv": 1}


@pytest.mark.parametrize(
    ("file", "reason", "n"),
    [("gone.csv", "bad_pack", 1), ("a.csv", "bad_pack", 0), ("gone.csv", BREAKS_DECLARATION, 0)],
)
def test_quarantine_of_removed_files_stays(stored, file, reason, n):
    """That of computed rows belongs to their own stage."""
    row = {"operator": "AQX", "tail": "LX-AAA", "file": file, "reason": reason, "n_rows": 1, "scope": "row"}

    assert stored(raw_quarantine=[row]).quarantine().height == n


@pytest.mark.parametrize(
    ("path", "folder"),
    [("fleet.csv", ("", "")), ("types/a.toml", ("", "")), ("AQX/LX-AAA/messages.csv", ("AQX", "LX-AAA"))],
)
def test_files_of_the_fleet_have_no_aircraft(path, folder):
    assert folder_of(path) == folder
