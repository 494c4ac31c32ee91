"""What a store promises, whoever keeps the shards: a merge touches its flights alone, a reader sees all or nothing."""

import shutil
import threading
from datetime import UTC, datetime

import duckdb
import polars as pl
import pyarrow as pa
import pytest
from deltalake import DeltaTable, Schema

from hdt_core.tables import TABLES
from pipelines.storage.delta import Deltas
from pipelines.storage.files import replacing
from pipelines.storage.objects import StoreError
from pipelines.storage.store import FLEET, Store, shard_of

AIRCRAFT = ("AQX", "LX-AAA")
MAY, MAY_TOO, JUNE = "LX-AAA_20240501_01", "LX-AAA_20240502_01", "LX-AAA_20240601_01"


@pytest.fixture(params=["files", "objects"])
def store(request, tmp_path) -> Store:
    """A store of each kind."""
    return Store(tmp_path, "" if request.param == "files" else request.getfixturevalue("s3_url"))


def flights(*ids: str, n: int = 1) -> pl.DataFrame:
    at = datetime(2024, 5, 1, tzinfo=UTC)
    rows = {"operator": "AQX", "tail": "LX-AAA", "departed_at": at, "landed_at": at, "source": "acms", "n_seconds": 0}
    frame = pl.DataFrame([rows | {"flight_id": i, "n_snapshots": n} for i in ids])
    return TABLES["raw_flights"].conform(frame)


def stored_counts(store: Store) -> dict[str, int]:
    return dict(store.read_table("raw_flights").select("flight_id", "n_snapshots").rows())


def test_merge_replaces_the_flights_named_and_keeps_the_others(store):
    store.merge("raw_flights", {AIRCRAFT: [MAY, MAY_TOO, JUNE]}, flights(MAY, MAY_TOO, JUNE))
    store.merge("raw_flights", {AIRCRAFT: [MAY]}, flights(MAY, n=7))
    assert stored_counts(store) == {MAY: 7, MAY_TOO: 1, JUNE: 1}
    assert len(store.tables.sources("raw_flights")) == 2  # a shard a month


def test_merge_of_no_rows_removes_what_was_there_and_makes_no_shard(store):
    store.merge("raw_flights", {AIRCRAFT: [MAY]}, flights())
    assert not store.tables.sources("raw_flights")
    store.merge("raw_flights", {AIRCRAFT: [MAY]}, flights(MAY))
    store.merge("raw_flights", {AIRCRAFT: [MAY]}, flights())
    assert store.read_table("raw_flights").is_empty()


def test_one_aircraft_is_read_without_the_others(store):
    other = ("BZR", "LX-AAA")
    for operator, n in (("AQX", 1), ("BZR", 2)):
        own = flights(MAY, n=n).with_columns(operator=pl.lit(operator))
        store.merge("raw_flights", {(operator, "LX-AAA"): [MAY]}, own)
    assert store.read_table("raw_flights", [other])["n_snapshots"].to_list() == [2]
    assert sorted(store.read_table("raw_flights", [AIRCRAFT, other])["n_snapshots"]) == [1, 2]
    assert store.read_table("raw_flights", [("CCC", "LX-AAA")]).is_empty()


def test_a_reader_keeps_what_it_began_to_read_and_the_next_sees_the_new(s3_url, tmp_path):
    """Between a reader's first look and its last byte the shard is replaced, by objects of fresh names."""
    store = Store(tmp_path, s3_url)
    store.merge("raw_flights", {AIRCRAFT: [MAY]}, flights(MAY, n=1))
    first = store.scan("raw_flights")
    store.merge("raw_flights", {AIRCRAFT: [MAY]}, flights(MAY, n=2))
    second = store.scan("raw_flights")
    assert [f.collect()["n_snapshots"].to_list() for f in (first, second)] == [[1], [2]]


def test_two_writers_of_one_month_lose_nothing(store):
    """Runs of an aircraft's flights go side by side, and one may end and the next begin in the same month."""
    days = [[f"LX-AAA_202405{day:02}_{leg:02}" for day in range(1, 11)] for leg in (1, 2)]

    def write(ids: list[str]) -> None:
        for flight in ids:
            store.merge("raw_flights", {AIRCRAFT: [flight]}, flights(flight))

    both = [threading.Thread(target=write, args=(ids,)) for ids in days]
    for thread in both:
        thread.start()
    for thread in both:
        thread.join()
    assert sorted(stored_counts(store)) == sorted(days[0] + days[1])


def test_a_table_that_is_not_there_yet_reads_as_empty_with_its_columns(store):
    frame = store.read_table("prognoses")
    assert frame.is_empty()
    assert frame.columns == list(TABLES["prognoses"].schema.columns())
    store.declare("prognoses")
    store.declare("prognoses")
    assert len(store.tables.sources("prognoses")) == 1
    assert store.read_table("prognoses").equals(frame)


def test_the_fleet_has_one_shard(store):
    for version in ("1", "2"):
        row = pl.DataFrame({"model_version": [version], "card": ["{}"], "model": [b"x"]})
        store.replace("prognosis_model", [FLEET], row)
    assert store.read_table("prognosis_model")["model_version"].to_list() == ["2"]
    assert len(store.tables.sources("prognosis_model")) == 1


@pytest.mark.parametrize(
    "aircraft", [("..", "x"), ("AQX", "../../etc"), ("AQX", ""), ("aqx", "LX-AAA"), ("AQX", "A/B")]
)
def test_no_name_leads_out_of_home(aircraft):
    with pytest.raises(ValueError, match="not an operator and tail"):
        shard_of(aircraft)


def test_the_variable_says_where_the_tables_lie(tmp_path, monkeypatch):
    monkeypatch.setenv("HDT_STORE_URL", str(tmp_path / "elsewhere"))
    Store(tmp_path / "home").merge("raw_flights", {AIRCRAFT: [MAY]}, flights(MAY))
    assert len(list((tmp_path / "elsewhere/raw_flights/AQX/LX-AAA").glob("2024-05.*.parquet"))) == 1
    assert not (tmp_path / "home").exists()
    monkeypatch.setenv("HDT_STORE_URL", "gs://bucket")
    with pytest.raises(StoreError, match="HDT_STORE_URL is a folder or s3"):
        _ = Store(tmp_path).place
    monkeypatch.delenv("HDT_STORE_URL")
    assert Store(tmp_path / "home").place.url == str(tmp_path / "home/tables")


def test_the_same_rows_make_the_same_file_and_no_commit(store):
    ids = [MAY, MAY_TOO]
    store.merge("raw_flights", {AIRCRAFT: ids}, flights(*ids))
    first, version = store.tables.shards("raw_flights"), store.tables.open("raw_flights").version()
    store.merge("raw_flights", {AIRCRAFT: ids}, flights(*reversed(ids)))
    assert store.tables.shards("raw_flights") == first
    assert store.tables.open("raw_flights").version() == version


def test_many_aircraft_change_in_one_commit(store):
    other = ("BZR", "LX-AAA")
    both = pl.concat([flights(MAY), flights(MAY).with_columns(operator=pl.lit("BZR"))])
    store.merge("raw_flights", {AIRCRAFT: [MAY], other: [MAY]}, both)
    first = store.tables.open("raw_flights").version()
    store.merge("raw_flights", {AIRCRAFT: [MAY], other: [MAY]}, both.with_columns(n_snapshots=9))
    assert store.tables.open("raw_flights").version() == first + 1
    assert store.read_table("raw_flights")["n_snapshots"].to_list() == [9, 9]


def test_rows_of_what_was_not_asked_for_are_refused(store):
    store.merge("raw_flights", {AIRCRAFT: [MAY]}, flights(MAY, n=1))
    other = flights(MAY).with_columns(operator=pl.lit("BZR"))
    for frame, which in ((flights(MAY, MAY_TOO), MAY_TOO), (other, "BZR LX-AAA")):
        with pytest.raises(StoreError, match=rf"raw_flights: 1 rows are of nothing that was asked for.*{which}"):
            store.merge("raw_flights", {AIRCRAFT: [MAY]}, frame)
    with pytest.raises(StoreError, match="twin_health: 1 rows are of nothing that was asked for, such as BZR LX-AAA"):
        store.replace("twin_health", [AIRCRAFT], TABLES["twin_health"].conform(other))
    assert stored_counts(store) == {MAY: 1}


def test_a_key_that_would_stand_twice_is_refused_also_beside_rows_that_are_there(store):
    doubled = pl.concat([flights(MAY), flights(MAY, n=2)])
    with pytest.raises(StoreError, match=f"AQX/LX-AAA/2024-05 would hold 1 keys more than once, such as .*{MAY}"):
        store.merge("raw_flights", {AIRCRAFT: [MAY]}, doubled)
    assert store.read_table("raw_flights").is_empty()
    store.tables.write("raw_flights", {"AQX/LX-AAA/2024-05": doubled})  # past the store's check
    with pytest.raises(StoreError, match="more than once"):
        store.merge("raw_flights", {AIRCRAFT: [MAY_TOO]}, flights(MAY_TOO))
    store.merge("raw_flights", {AIRCRAFT: [MAY]}, flights(MAY))
    assert stored_counts(store) == {MAY: 1}


@pytest.mark.parametrize("table", TABLES)
def test_what_is_declared_is_what_delta_lake_can_keep(table):
    empty = TABLES[table].schema.create_empty()
    read_back = pl.from_arrow(pa.schema(Schema.from_arrow(empty.to_arrow().schema).to_arrow()).empty_table())
    assert read_back.schema == empty.schema


@pytest.mark.parametrize("table", TABLES)
def test_every_table_opens_with_polars_pyarrow_and_duckdb(sample_home, table):
    rows, path = Store(sample_home).read_table(table).height, str(sample_home / "tables" / table)
    delta = DeltaTable(path)
    assert pl.read_delta(path).height == pl.scan_delta(path).collect().height == rows
    assert delta.to_pyarrow_table().num_rows == delta.to_pyarrow_dataset().count_rows() == rows
    query = "select count(columns(*)) from read_parquet($files)", {"files": delta.file_uris()}
    assert max(duckdb.sql(query[0], params=query[1]).fetchall()[0]) == rows


def test_an_earlier_version_stays_readable(store):
    store.merge("raw_flights", {AIRCRAFT: [MAY]}, flights(MAY, n=1))
    then = store.tables.open("raw_flights").version()
    store.merge("raw_flights", {AIRCRAFT: [MAY, JUNE]}, flights(MAY, JUNE, n=2))
    (file,) = store.tables.version("raw_flights", then).shards.values()
    assert pl.read_parquet(store.place.get(f"raw_flights/{file}"))["n_snapshots"].to_list() == [1]


def test_a_table_is_opened_once_whoever_asks_and_again_after_anothers_commit(tmp_path, monkeypatch):
    """A log of years takes a while to read; another process may have written meanwhile."""
    opened, open_ = [], Deltas.open
    Store(tmp_path).declare("raw_flights")
    monkeypatch.setattr(Deltas, "open", lambda *arguments: opened.append(arguments) or open_(*arguments))
    for n in (1, 2):
        Store(tmp_path).merge("raw_flights", {AIRCRAFT: [MAY, JUNE]}, flights(MAY, JUNE, n=n))
        assert stored_counts(Store(tmp_path)) == {MAY: n, JUNE: n}
        assert Store(tmp_path).declare("raw_flights").number == n
    assert opened == []
    elsewhere = shutil.copytree(tmp_path / "tables", tmp_path / "other" / "tables").parent
    Store(elsewhere).merge("raw_flights", {AIRCRAFT: [MAY]}, flights(MAY, n=3))
    shutil.copytree(elsewhere / "tables", tmp_path / "tables", dirs_exist_ok=True)  # as another process would write
    opened.clear()
    assert stored_counts(Store(tmp_path)) == {MAY: 3, JUNE: 2}
    assert len(opened) == 1


def test_a_new_column_widens_the_table(tmp_path):
    """Other programs read the table by the log's schema: what is not there is null."""
    tables = Store(tmp_path).tables
    tables.change("t", lambda _: [("a", pl.DataFrame({"x": [1]}))])
    tables.change("t", lambda _: [("b", pl.DataFrame({"x": [2], "y": ["new"]}))])
    read = pl.scan_delta(str(tmp_path / "tables/t")).sort("x").collect()
    assert read.rows() == [(1, None), (2, "new")]


def test_a_writer_that_dies_leaves_the_old_file_and_nothing_else(tmp_path):
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


def test_leftovers_of_a_killed_writer_are_swept_and_never_read(tmp_path):
    store = Store(tmp_path)
    store.merge("raw_flights", {AIRCRAFT: [MAY]}, flights(MAY))
    left = tmp_path / "tables/raw_flights/AQX/LX-AAA/.2024-05.0.parquet.99.part"
    left.write_bytes(b"PAR1 torn")
    assert store.read_table("raw_flights").height == 1
    assert store.sweep() == 1
    assert not left.exists()
