"""What a store promises, whoever keeps the shards: all or nothing, and every flight once, wherever its month lies."""

import random
import shutil
import threading
from datetime import UTC, datetime

import duckdb
import polars as pl
import pyarrow as pa
import pytest
from deltalake import DeltaTable, Schema

from hdt_core.tables import TABLES
from pipelines.repair import repair_home
from pipelines.storage.delta import Deltas
from pipelines.storage.files import replacing
from pipelines.storage.ledger import Ledger
from pipelines.storage.objects import StoreError
from pipelines.storage.store import FLEET, OPEN, Store

AIRCRAFT = ("AQX", "LX-AAA")
MAY = "LX-AAA_20240501_01"
MAY_TOO = "LX-AAA_20240502_01"
JUNE = "LX-AAA_20240601_01"


@pytest.fixture(params=["files", "objects"])
def store(request, tmp_path) -> Store:
    """A store of each kind."""
    return Store(tmp_path, "" if request.param == "files" else request.getfixturevalue("s3_url"))


def flights_of(*ids: str, n: int = 1) -> pl.DataFrame:
    at = datetime(2024, 5, 1, tzinfo=UTC)
    rows = {"operator": "AQX", "tail": "LX-AAA", "departed_at": at, "landed_at": at, "source": "acms", "n_seconds": 0}
    return TABLES["raw_flights"].conform(pl.DataFrame([rows | {"flight_id": i, "n_snapshots": n} for i in ids]))


def merge(store: Store, ids: list[str], n: int = 1) -> None:
    store.merge("raw_flights", {AIRCRAFT: ids}, flights_of(*ids, n=n))


def stored_rows(store: Store) -> list[tuple[str, int]]:
    return sorted(store.read_table("raw_flights").select("flight_id", "n_snapshots").rows())


def test_empty_merge_makes_no_shard(store):
    store.merge("raw_flights", {AIRCRAFT: [MAY]}, flights_of())
    assert not store.tables.shards("raw_flights")


def test_empty_merge_removes_the_flight(store):
    merge(store, [MAY])
    store.merge("raw_flights", {AIRCRAFT: [MAY]}, flights_of())
    assert store.read_table("raw_flights").is_empty()


def test_aircraft_is_read_alone(store):
    other = ("BZR", "LX-AAA")
    for operator, n in (("AQX", 1), ("BZR", 2)):
        own = flights_of(MAY, n=n).with_columns(operator=pl.lit(operator))
        store.merge("raw_flights", {(operator, "LX-AAA"): [MAY]}, own)
    assert store.read_table("raw_flights", [other])["n_snapshots"].to_list() == [2]
    assert sorted(store.read_table("raw_flights", [AIRCRAFT, other])["n_snapshots"]) == [1, 2]
    assert store.read_table("raw_flights", [("CCC", "LX-AAA")]).is_empty()


def test_reader_keeps_its_version(s3_url, tmp_path):
    """Between a reader's first look and its last byte the shard is replaced, by objects of fresh names."""
    store = Store(tmp_path, s3_url)
    merge(store, [MAY], n=1)
    first = store.scan("raw_flights")
    merge(store, [MAY], n=2)
    second = store.scan("raw_flights")
    assert [f.collect()["n_snapshots"].to_list() for f in (first, second)] == [[1], [2]]


def test_two_writers_lose_nothing(store):
    """Runs of an aircraft's flights go side by side, and one may end and the next begin in the same month."""
    days = [[f"LX-AAA_202405{day:02}_{leg:02}" for day in range(1, 11)] for leg in (1, 2)]

    def write(ids: list[str]) -> None:
        for flight in ids:
            merge(store, [flight])

    both = [threading.Thread(target=write, args=(ids,)) for ids in days]
    for thread in both:
        thread.start()
    for thread in both:
        thread.join()
    assert [flight for flight, _ in stored_rows(store)] == sorted(days[0] + days[1])


def test_missing_table_reads_as_empty(store):
    frame = store.read_table("prognoses")
    assert frame.is_empty()
    assert frame.columns == list(TABLES["prognoses"].schema.columns())


def test_declared_table_has_one_shard(store):
    frame = store.read_table("prognoses")
    for _ in range(2):
        store.declare("prognoses")
    assert len(store.tables.shards("prognoses")) == 1
    assert store.read_table("prognoses").equals(frame)


def test_fleet_table_has_one_shard(store):
    for version in ("1", "2"):
        row = pl.DataFrame({"model_version": [version], "card": ["{}"], "model": [b"x"]})
        store.replace("prognosis_model", [FLEET], row)
    assert store.read_table("prognosis_model")["model_version"].to_list() == ["2"]
    assert len(store.tables.shards("prognosis_model")) == 1


def test_variable_places_the_tables(tmp_path, monkeypatch):
    monkeypatch.setenv("HDT_STORE_URL", str(tmp_path / "elsewhere"))
    merge(Store(tmp_path / "home"), [MAY])
    assert len(list((tmp_path / "elsewhere/raw_flights/AQX/LX-AAA").glob("2024-05.*.parquet"))) == 1
    assert not (tmp_path / "home").exists()


def test_unknown_place_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("HDT_STORE_URL", "gs://bucket")
    with pytest.raises(StoreError, match="HDT_STORE_URL is a folder or s3"):
        _ = Store(tmp_path).place


def test_tables_lie_below_the_home(tmp_path, monkeypatch):
    monkeypatch.delenv("HDT_STORE_URL", raising=False)
    assert Store(tmp_path / "home").place.url == str(tmp_path / "home/tables")


def test_same_rows_make_no_commit(store):
    ids = [MAY, MAY_TOO]
    merge(store, ids)
    first = store.tables.shards("raw_flights")
    version = store.tables.open("raw_flights").version()
    merge(store, ids[::-1])
    assert store.tables.shards("raw_flights") == first
    assert store.tables.open("raw_flights").version() == version


def test_many_aircraft_make_one_commit(store):
    merge(store, [MAY, MAY_TOO])
    other = ("BZR", "LX-AAA")
    both = pl.concat([flights_of(MAY), flights_of(MAY).with_columns(operator=pl.lit("BZR"))])
    store.merge("raw_flights", {AIRCRAFT: [MAY], other: [MAY]}, both)
    first = store.tables.open("raw_flights").version()
    store.merge("raw_flights", {AIRCRAFT: [MAY], other: [MAY]}, both.with_columns(n_snapshots=9))
    assert store.tables.open("raw_flights").version() == first + 1
    assert store.read_table("raw_flights")["n_snapshots"].to_list() == [9, 1, 9]  # MAY_TOO as it was


def test_stray_rows_are_refused(store):
    merge(store, [MAY], n=1)
    other = flights_of(MAY).with_columns(operator=pl.lit("BZR"))
    for frame, which in ((flights_of(MAY, MAY_TOO), MAY_TOO), (other, "BZR LX-AAA")):
        with pytest.raises(StoreError, match=rf"raw_flights: 1 rows are of nothing that was asked for.*{which}"):
            store.merge("raw_flights", {AIRCRAFT: [MAY]}, frame)
    with pytest.raises(StoreError, match="twin_health: 1 rows are of nothing that was asked for, such as BZR LX-AAA"):
        store.replace("twin_health", [AIRCRAFT], TABLES["twin_health"].conform(other))
    assert stored_rows(store) == [(MAY, 1)]


DOUBLED = pl.concat([flights_of(MAY), flights_of(MAY, n=2)])


def test_repeated_key_is_refused(store):
    with pytest.raises(StoreError, match=f"AQX/LX-AAA/2024-05 would hold 1 keys more than once, such as .*{MAY}"):
        store.merge("raw_flights", {AIRCRAFT: [MAY]}, DOUBLED)
    assert store.read_table("raw_flights").is_empty()


def test_stored_repetition_stops_a_merge(store):
    """Until the flight comes again."""
    store.tables.write("raw_flights", {"AQX/LX-AAA/2024-05": DOUBLED})  # past the store's check
    with pytest.raises(StoreError, match="more than once"):
        store.merge("raw_flights", {AIRCRAFT: [MAY_TOO]}, flights_of(MAY_TOO))
    merge(store, [MAY])
    assert stored_rows(store) == [(MAY, 1)]


@pytest.mark.parametrize("table", TABLES)
def test_other_libraries_open_the_table(sample_home, table):
    rows = Store(sample_home).read_table(table).height
    path = str(sample_home / "tables" / table)
    delta = DeltaTable(path)
    assert pl.read_delta(path).height == pl.scan_delta(path).collect().height == rows
    assert delta.to_pyarrow_table().num_rows == delta.to_pyarrow_dataset().count_rows() == rows
    query = "select count(columns(*)) from read_parquet($files)", {"files": delta.file_uris()}
    assert max(duckdb.sql(query[0], params=query[1]).fetchall()[0]) == rows
    empty = TABLES[table].schema.create_empty()
    read_back = pl.from_arrow(pa.schema(Schema.from_arrow(empty.to_arrow().schema).to_arrow()).empty_table())
    assert read_back.schema == empty.schema


@pytest.fixture
def openings(tmp_path, monkeypatch) -> list[tuple]:
    """How often a declared table is opened."""
    calls = []
    open_table = Deltas.open
    Store(tmp_path).declare("raw_flights")
    monkeypatch.setattr(Deltas, "open", lambda *arguments: calls.append(arguments) or open_table(*arguments))
    return calls


def test_table_is_opened_once(tmp_path, openings):
    """Whoever asks: a log of years takes a while to read."""
    for n in (1, 2):
        merge(Store(tmp_path), [MAY, JUNE], n)
        assert stored_rows(Store(tmp_path)) == [(MAY, n), (JUNE, n)]
        assert Store(tmp_path).declare("raw_flights").number == n
    assert openings == []


def test_foreign_commit_reopens_the_table(tmp_path, openings):
    """Another process may write meanwhile."""
    merge(Store(tmp_path), [MAY, JUNE], 2)
    elsewhere = shutil.copytree(tmp_path / "tables", tmp_path / "other" / "tables").parent
    merge(Store(elsewhere), [MAY], 3)
    shutil.copytree(elsewhere / "tables", tmp_path / "tables", dirs_exist_ok=True)
    openings.clear()
    assert stored_rows(Store(tmp_path)) == [(MAY, 3), (JUNE, 2)]
    assert len(openings) == 1


def test_new_column_widens_the_table(tmp_path):
    """Other programs read the table by the log's schema: what is not there is null."""
    tables = Store(tmp_path).tables
    tables.change("t", lambda _: [("a", pl.DataFrame({"x": [1]}))])
    tables.change("t", lambda _: [("b", pl.DataFrame({"x": [2], "y": ["new"]}))])
    read = pl.scan_delta(str(tmp_path / "tables/t")).sort("x").collect()
    assert read.rows() == [(1, None), (2, "new")]


def test_dead_writer_leaves_old_file(tmp_path):
    target = tmp_path / "a.parquet"
    target.write_text("old")

    def die() -> None:
        with replacing(target) as temporary:
            temporary.write_text("new, half writ")
            raise RuntimeError("died")

    with pytest.raises(RuntimeError, match="died"):
        die()
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.parquet"]


def test_leftovers_are_swept(tmp_path):
    store = Store(tmp_path)
    merge(store, [MAY])
    left = tmp_path / "tables/raw_flights/AQX/LX-AAA/.2024-05.0.parquet.99.part"
    left.write_bytes(b"PAR1 torn")
    assert store.read_table("raw_flights").height == 1
    assert store.sweep() == 1
    assert not left.exists()


MONTHS = [f"{year}{month:02}" for year in (2022, 2023, 2024) for month in range(1, 13)]
FLIGHTS = [f"LX-AAA_{month}{day:02}_01" for month in MONTHS for day in (3, 17)]


def names(store: Store) -> list[str]:
    return sorted(shard.rpartition("/")[2] for shard in store.tables.shards("raw_flights"))


def test_years_fold_older_months(tmp_path):
    merge(store := Store(tmp_path), FLIGHTS)
    assert names(store) == ["2022", "2023", "2024", "2024-10", "2024-11", "2024-12"]
    assert stored_rows(store) == [(flight, 1) for flight in FLIGHTS]
    assert set(store.scan("raw_flights", [AIRCRAFT], FLIGHTS[-2:]).collect()["flight_id"]) == set(FLIGHTS[-2:])


@pytest.mark.parametrize("seed", range(8))
def test_any_order_keeps_flights_once(tmp_path, seed):
    check_any_order(Store(tmp_path), seed, nights=40)


def test_objects_keep_flights_once(tmp_path, s3_url):
    check_any_order(Store(tmp_path, s3_url), seed=8, nights=15)


def check_any_order(store: Store, seed: int, nights: int) -> None:
    """Nights in order, late flights, whole histories and flights that vanish, against a plain dictionary."""
    rng = random.Random(seed)
    expected = dict[str, int]()
    for n in range(nights):
        flights = rng.sample(FLIGHTS, rng.choice((1, 2, 5, 30)))
        removed = set(flights) if rng.random() < 0.1 else set()
        store.merge("raw_flights", {AIRCRAFT: flights}, flights_of(*sorted(set(flights) - removed), n=n))
        expected = {f: k for f, k in expected.items() if f not in removed} | dict.fromkeys(set(flights) - removed, n)
        assert stored_rows(store) == sorted(expected.items())
        sample = rng.sample(FLIGHTS, 3)
        result = store.scan("raw_flights", [AIRCRAFT], sample).collect()["flight_id"]
        assert set(result) >= set(sample) & set(expected)
    assert len([name for name in names(store) if "-" in name]) <= OPEN


@pytest.mark.parametrize("months", [["2024-12"], ["2024-11", "2024-12"], ["2024"], ["2024-10", "2024-11", "2024-12"]])
def test_lost_months_return_once(tmp_path, months):
    """With the newest months gone, others are the newest: they stay in the year that has taken them in."""
    merge(store := Store(tmp_path), FLIGHTS)
    files = store.tables.shards("raw_flights")
    store.tables.remove_files("raw_flights", [files[f"AQX/LX-AAA/{name}"] for name in months])
    late = [f for f in FLIGHTS if "_202409" in f]
    merge(store, late, n=3)
    left = set(store.read_table("raw_flights")["flight_id"])
    merge(store, [f for f in FLIGHTS if f not in left], n=2)
    assert [flight for flight, _ in stored_rows(store)] == FLIGHTS
    assert {n for flight, n in stored_rows(store) if flight in late} == {3}


def test_lost_year_makes_flights_stale(tmp_path):
    store = Store(tmp_path / "home")
    ledger = Ledger(tmp_path / "home")
    merge(store, FLIGHTS)
    done = [{"operator": "AQX", "tail": "LX-AAA", "flight_id": f, "version": "1"} for f in FLIGHTS]
    ledger.mark("raw_flights", pl.DataFrame(done))
    ledger.note_snapshot({"raw_flights": 0})
    file = store.tables.shards("raw_flights")["AQX/LX-AAA/2023"]
    (store.place.root / "raw_flights" / file).write_bytes(b"torn")
    repair_home(tmp_path / "landing", store, ledger)
    assert sorted(ledger.cells("raw_flights")["flight_id"]) == [f for f in FLIGHTS if "_2023" not in f]
    assert [flight for flight, _ in stored_rows(store)] == [f for f in FLIGHTS if "_2023" not in f]


def test_rebuilt_log_counts_months_once(tmp_path):
    store = Store(tmp_path / "home")
    ledger = Ledger(tmp_path / "home")
    for month in range(0, len(FLIGHTS), 2):
        merge(store, FLIGHTS[month : month + 2])
    ledger.note_snapshot({"raw_flights": store.tables.open("raw_flights").version()})
    for commit in (store.place.root / "raw_flights/_delta_log").iterdir():
        commit.unlink()
    repair_home(tmp_path / "landing", store, ledger)
    assert [flight for flight, _ in stored_rows(store)] == FLIGHTS
