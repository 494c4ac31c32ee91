"""Earlier nights: what was believed when, for how long it is kept, and what is told where it is not."""

import re
import shutil
from pathlib import Path

import polars as pl
import pytest
from nights import empty_home

from hdt_core.tables import TABLES
from pipelines.storage.catalog import connect
from pipelines.storage.ledger import Ledger
from pipelines.storage.objects import StoreError
from pipelines.storage.publication import connect_as_of, publish
from pipelines.storage.seal import Retention, find_night, remove_expired
from pipelines.storage.store import Store

AIRCRAFT, FLIGHT = ("AQX", "LX-AAA"), "LX-AAA_20240501_01"
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


def test_each_night_says_what_it_said_and_its_reader_reaches_nothing_else(four):
    assert [snapshots_of(connect_as_of(four, name)) for name in names(four)] == list(range(NIGHTS))
    assert snapshots_of(connect_as_of(four, max(names(four))[:10])) == NIGHTS - 1
    assert snapshots_of(connect(four)) == NIGHTS - 1
    with connect_as_of(four, names(four)[0]) as con, pytest.raises(Exception, match="disabled by configuration"):
        con.execute("select * from read_text('/etc/passwd')").fetchall()
    with pytest.raises(StoreError, match=f"the first on record is {names(four)[0][:10]}"):
        connect_as_of(four, "2001-01-01")
    with pytest.raises(StoreError, match="none is on record"):
        find_night({}, "2024-01-01")


def test_the_last_night_by_a_day_or_an_hour_is_meant():
    nights = {name: {} for name in ("2024-03-01T02:00:00", "2024-03-01T23:00:00", "2024-03-03T02:00:00")}
    for day, meant in (("2024-03-01", 1), ("2024-03-02", 1), ("2024-03-01T02", 0), ("2025", 2), ("2024-03-03", 2),
                       ("2024-03-01 23:30", 1), ("2024-03-01T23:00:00+00:00", 1)):  # fmt: skip
        assert find_night(nights, day)[0] == list(nights)[meant]


@pytest.mark.parametrize("text", ["yesterday", "26.06.2024", "06/26/2024", "2024-6-1", "2024-03-01T02:00+02:00", ""])
def test_what_is_no_day_and_no_time_in_utc_finds_no_night(text):
    with pytest.raises(StoreError, match="give a day"):
        find_night({"2001-01-01T02:00:00": {}}, text)


def test_what_is_beyond_its_time_goes_and_what_is_held_stays(home):
    store, ledger, before = Store(home), Ledger(home), names(home)
    remove_expired(store, ledger, Retention(keep_days=0, hold=(before[1],)))
    assert names(home) == [before[1]]
    assert snapshots_of(connect_as_of(home, before[1])) == 1
    assert snapshots_of(connect(home)) == NIGHTS - 1
    files = list((home / "tables/raw_flights/AQX/LX-AAA").glob("*.parquet"))
    assert len(files) == 2  # the night that is held, and now
    with pytest.raises(StoreError, match="no night at or before"):
        connect_as_of(home, before[0])
    store.merge("raw_flights", {AIRCRAFT: [FLIGHT]}, flight(9))
    publish(home)
    assert snapshots_of(connect(home)) == 9


def test_a_long_log_is_read_from_a_checkpoint_on(home):
    store = Store(home)
    for n in range(25):
        store.merge("raw_flights", {AIRCRAFT: [FLIGHT]}, flight(100 + n))
    before = store.read_table("raw_flights")
    remove_expired(store, Ledger(home), Retention())
    assert list((home / "tables/raw_flights/_delta_log").glob("*.checkpoint.parquet"))
    assert store.read_table("raw_flights").equals(before)


def test_a_file_of_an_earlier_night_that_is_damaged_is_told(home):
    first = names(home)[0]
    (file,) = Store(home).snapshot(Ledger(home).snapshots()[first])["raw_flights"][1][:1]
    (home / "tables" / file).write_bytes(b"PAR1")
    with pytest.raises(StoreError, match=f"the night of {re.escape(first)} is not kept whole"):
        connect_as_of(home, first)
