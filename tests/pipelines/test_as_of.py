"""Earlier nights: what was believed when, for how long it is kept, and what answers where it is not."""

import re
import shutil
import sqlite3
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import duckdb
import polars as pl
import pytest
from nights import empty_home

from hdt_core.tables import TABLES
from pipelines.storage import ledger, retention
from pipelines.storage.catalog import CATALOG, connect
from pipelines.storage.catalog_checks import find_catalog_fault
from pipelines.storage.ledger import FILE, Ledger
from pipelines.storage.objects import StoreError
from pipelines.storage.publication import connect_as_of, publish
from pipelines.storage.retention import find_night, remove_expired
from pipelines.storage.settings import Retention
from pipelines.storage.store import Store

AIRCRAFT = ("AQX", "LX-AAA")
FLIGHT = "LX-AAA_20240501_01"
NIGHTS = 4


def flight(n_snapshots: int) -> pl.DataFrame:
    row = {"operator": "AQX", "tail": "LX-AAA", "flight_id": FLIGHT, "source": "acms", "n_snapshots": n_snapshots}
    return TABLES["raw_flights"].conform(pl.DataFrame([row]))


def snapshots_of(con) -> int:
    with con:
        return con.execute("select n_snapshots from flights").fetchone()[0]


@pytest.fixture(scope="module")
def four(tmp_path_factory) -> Path:
    """Four nights, each of which counts one snapshot more of one flight. Read only."""
    home = tmp_path_factory.mktemp("four")
    store = empty_home(home)
    for n in range(NIGHTS):
        store.merge("raw_flights", {AIRCRAFT: [FLIGHT]}, flight(n))
        publish(home)
    return home


@pytest.fixture
def home(four, tmp_path) -> Path:
    return Path(shutil.copytree(four, tmp_path / "home"))


def names(home: Path) -> list[str]:
    return list(Ledger(home).snapshots())


def test_each_night_answers_as_then(four):
    assert [snapshots_of(connect_as_of(four, name)) for name in names(four)] == list(range(NIGHTS))


def test_day_means_its_last_night(four):
    assert snapshots_of(connect_as_of(four, max(names(four))[:10])) == snapshots_of(connect(four)) == NIGHTS - 1


def test_reader_reaches_no_other_file(four):
    with connect_as_of(four, names(four)[0]) as con, pytest.raises(Exception, match="disabled by configuration"):
        con.execute("select * from read_text('/etc/passwd')").fetchall()


def test_night_before_first_is_refused(four):
    with pytest.raises(StoreError, match=f"the first on record is {names(four)[0][:10]}"):
        connect_as_of(four, "2001-01-01")


def test_home_without_night_finds_none():
    with pytest.raises(StoreError, match="none is on record"):
        find_night({}, "2024-01-01")


@pytest.mark.parametrize(
    ("text", "nth"),
    [("2024-03-01", 1), ("2024-03-02", 1), ("2024-03-01T02", 0), ("2025", 2), ("2024-03-03", 2),
     ("2024-03-01 23:30", 1), ("2024-03-01T23:00:00+00:00", 1)],
)  # fmt: skip
def test_day_or_hour_names_night(text, nth):
    nights = ("2024-03-01T02:00:00", "2024-03-01T23:00:00", "2024-03-03T02:00:00")
    assert find_night({name: {} for name in nights}, text)[0] == nights[nth]


@pytest.mark.parametrize("text", ["yesterday", "26.06.2024", "06/26/2024", "2024-6-1", "2024-03-01T02:00+02:00", ""])
def test_odd_time_names_no_night(text):
    with pytest.raises(StoreError, match="give a day"):
        find_night({"2001-01-01T02:00:00": {}}, text)


def test_retention_spares_named_nights(home):
    store = Store(home)
    ledger = Ledger(home)
    before = names(home)
    remove_expired(store, ledger, Retention(keep_days=0, hold=(before[1],)))
    assert names(home) == [before[1], before[-1]]  # the last has not been replaced
    assert snapshots_of(connect_as_of(home, before[1])) == 1
    assert snapshots_of(connect(home)) == NIGHTS - 1
    files = list((home / "tables/raw_flights/AQX/LX-AAA").glob("*.parquet"))
    assert len(files) == 2  # the night that is held, and now
    with pytest.raises(StoreError, match="no night at or before"):
        connect_as_of(home, before[0])
    store.merge("raw_flights", {AIRCRAFT: [FLIGHT]}, flight(9))
    publish(home)
    assert snapshots_of(connect(home)) == 9


def test_long_log_gets_a_checkpoint(home):
    store = Store(home)
    for n in range(25):
        store.merge("raw_flights", {AIRCRAFT: [FLIGHT]}, flight(100 + n))
    before = store.read_table("raw_flights")
    remove_expired(store, Ledger(home), Retention())
    assert list((home / "tables/raw_flights/_delta_log").glob("*.checkpoint.parquet"))
    assert store.read_table("raw_flights").equals(before)


def test_damaged_night_is_refused(home):
    first = names(home)[0]
    (file,) = Store(home).snapshot(Ledger(home).snapshots()[first])["raw_flights"][1][:1]
    (home / "tables" / file).write_bytes(b"PAR1")
    with pytest.raises(StoreError, match=f"the night of {re.escape(first)} is not kept whole"):
        connect_as_of(home, first)


def at(monkeypatch: pytest.MonkeyPatch, years: int) -> None:
    """The clock of the nights and of their retention, so many years ahead."""
    for module in (ledger, retention):
        clock = SimpleNamespace(now=lambda zone: datetime.now(zone) + timedelta(days=365 * years))
        monkeypatch.setattr(module, "datetime", SimpleNamespace(**vars(clock), fromisoformat=datetime.fromisoformat))


@pytest.mark.parametrize("years", [10, -5])
def test_clock_jump_costs_no_night(home, monkeypatch, years):
    before = names(home)
    store = Store(home)
    at(monkeypatch, years)
    for _ in range(2):
        publish(home)
        remove_expired(store, Ledger(home), Retention())
    at(monkeypatch, 0)
    publish(home)
    remove_expired(store, Ledger(home), Retention())
    assert names(home)[:NIGHTS] == before
    assert Ledger(home).last_night()[:4] == f"{datetime.now(UTC):%Y}"


def test_foreign_catalog_is_refused(home, tmp_path):
    other = Path(shutil.copytree(home, tmp_path / "other"))
    for _ in range(2):
        publish(other)
    shutil.copyfile(other / CATALOG, home / CATALOG)
    with pytest.raises(StoreError, match="is not that of the last night"):
        connect(home)


def test_home_of_earlier_version_answers(home):
    """Its nights have no numbers, and its catalog names none."""
    with closing(sqlite3.connect(home / FILE)) as con, con:
        con.execute("update night_versions set night = substr(night, 1, instr(night, '#') - 1)")
    with duckdb.connect(str(home / CATALOG)) as con:
        con.execute("drop macro tables.made_by; drop macro tables.made_after")
    assert snapshots_of(connect(home)) == NIGHTS - 1
    publish(home)
    assert snapshots_of(connect(home)) == NIGHTS - 1


def test_earlier_catalog_is_a_fault(home, tmp_path):
    publish(home)
    earlier = shutil.copyfile(home / CATALOG, tmp_path / "earlier")
    publish(home)
    assert find_catalog_fault(home) is None
    shutil.copyfile(earlier, home / CATALOG)
    assert find_catalog_fault(home) == "it was not that of the last night"


def test_newer_tables_are_a_fault(home):
    publish(home)
    Store(home).merge("raw_flights", {AIRCRAFT: [FLIGHT]}, flight(9))
    assert find_catalog_fault(home) == "it was older than the tables"
