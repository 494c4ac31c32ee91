"""A file is there whole or not at all, and a merge touches the flights it was told and no other."""

from datetime import UTC, datetime

import polars as pl
import pytest

from hdt_core.tables import TABLES
from pipelines.store import FLEET, Store, replacing

AIRCRAFT = ("AQX", "LX-AAA")


def flights(*ids: str, n: int = 1) -> pl.DataFrame:
    at = datetime(2024, 5, 1, tzinfo=UTC)
    rows = {"operator": "AQX", "tail": "LX-AAA", "departed_at": at, "landed_at": at, "source": "acms", "n_seconds": 0}
    frame = pl.DataFrame([rows | {"flight_id": i, "n_snapshots": n} for i in ids])
    return TABLES["raw_flights"].conform(frame)


def test_merge_replaces_the_flights_named_and_keeps_the_others(tmp_path):
    store, may, june = Store(tmp_path), "LX-AAA_20240501_01", "LX-AAA_20240601_01"
    other = "LX-AAA_20240502_01"
    store.merge("raw_flights", AIRCRAFT, [may, other, june], flights(may, other, june))
    store.merge("raw_flights", AIRCRAFT, [may], flights(may, n=7))
    held = dict(store.read("raw_flights").select("flight_id", "n_snapshots").rows())
    assert held == {may: 7, other: 1, june: 1}
    assert {p.name for p in store.files("raw_flights")} == {"2024-05.parquet", "2024-06.parquet"}


def test_merge_of_no_rows_removes_what_was_there_and_makes_no_file(tmp_path):
    store, may = Store(tmp_path), "LX-AAA_20240501_01"
    store.merge("raw_flights", AIRCRAFT, [may], flights())
    assert not store.files("raw_flights")
    store.merge("raw_flights", AIRCRAFT, [may], flights(may))
    store.merge("raw_flights", AIRCRAFT, [may], flights())
    assert store.read("raw_flights").is_empty()


def test_the_same_rows_make_the_same_file(tmp_path):
    store, ids = Store(tmp_path), ["LX-AAA_20240501_01", "LX-AAA_20240502_01"]
    store.merge("raw_flights", AIRCRAFT, ids, flights(*ids))
    first = store.path("raw_flights", AIRCRAFT, "2024-05").read_bytes()
    store.merge("raw_flights", AIRCRAFT, ids, flights(*reversed(ids)))
    assert store.path("raw_flights", AIRCRAFT, "2024-05").read_bytes() == first


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
    store.merge("raw_flights", AIRCRAFT, ["LX-AAA_20240501_01"], flights("LX-AAA_20240501_01"))
    left = store.path("raw_flights", AIRCRAFT).with_name(".2024-05.parquet.99.part")
    left.write_bytes(b"PAR1 torn")
    assert store.read("raw_flights").height == 1
    assert store.sweep() == 1
    assert not left.exists()


@pytest.mark.parametrize(
    "aircraft", [("..", "x"), ("AQX", "../../etc"), ("AQX", ""), ("aqx", "LX-AAA"), ("AQX", "A/B")]
)
def test_no_name_leads_out_of_home(tmp_path, aircraft):
    with pytest.raises(ValueError, match="not an operator and tail"):
        Store(tmp_path).path("raw_flights", aircraft)


def test_a_table_that_is_not_there_yet_reads_as_empty_with_its_columns(tmp_path):
    frame = Store(tmp_path).read("prognoses")
    assert frame.is_empty()
    assert frame.columns == list(TABLES["prognoses"].schema.columns())


def test_the_fleet_has_one_file(tmp_path):
    store = Store(tmp_path)
    store.replace("prognosis_model", FLEET, pl.DataFrame({"model_version": ["1"], "card": ["{}"], "model": [b"x"]}))
    assert store.path("prognosis_model", FLEET) == tmp_path / "tables/prognosis_model/fleet.parquet"
