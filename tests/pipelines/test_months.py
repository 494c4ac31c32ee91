"""Where an aircraft's months lie: the newest in files of their own, the others in their year's, every flight once."""

import random
from datetime import UTC, datetime

import polars as pl
import pytest

from hdt_core.tables import TABLES
from pipelines.repair import repair_home
from pipelines.storage.ledger import Ledger
from pipelines.storage.months import OPEN
from pipelines.storage.store import Store

AIRCRAFT = ("AQX", "LX-AAA")
MONTHS = [f"{year}{month:02}" for year in (2022, 2023, 2024) for month in range(1, 13)]
FLIGHTS = [f"LX-AAA_{month}{day:02}_01" for month in MONTHS for day in (3, 17)]


def rows(ids: list[str], n: int) -> pl.DataFrame:
    at = datetime(2024, 5, 1, tzinfo=UTC)
    own = {"operator": "AQX", "tail": "LX-AAA", "departed_at": at, "landed_at": at, "source": "acms", "n_seconds": 0}
    frame = pl.DataFrame({"flight_id": ids}, schema={"flight_id": pl.String}).with_columns(n_snapshots=n)
    return TABLES["raw_flights"].conform(frame.with_columns(pl.lit(value).alias(name) for name, value in own.items()))


def merge(store: Store, ids: list[str], n: int = 0) -> None:
    store.merge("raw_flights", {AIRCRAFT: ids}, rows(ids, n))


def stored_rows(store: Store) -> list[tuple[str, int]]:
    return sorted(store.read_table("raw_flights").select("flight_id", "n_snapshots").rows())


def names(store: Store) -> list[str]:
    return sorted(shard.rpartition("/")[2] for shard in store.tables.shards("raw_flights"))


def test_years_take_in_all_months_but_the_newest(tmp_path):
    merge(store := Store(tmp_path), FLIGHTS)
    assert names(store) == ["2022", "2023", "2024", "2024-10", "2024-11", "2024-12"]
    assert stored_rows(store) == [(flight, 0) for flight in FLIGHTS]


@pytest.mark.parametrize("seed", range(8))
def test_every_flight_is_held_once_and_as_it_came_last_in_whatever_order(tmp_path, seed):
    check_any_order(Store(tmp_path), seed, nights=40)


def test_and_so_it_is_over_objects(tmp_path, s3_url):
    check_any_order(Store(tmp_path, s3_url), seed=8, nights=15)


def check_any_order(store: Store, seed: int, nights: int) -> None:
    """Nights in order, late flights, whole histories and flights that vanish, against a plain dictionary."""
    rng, expected = random.Random(seed), dict[str, int]()
    for n in range(nights):
        flights = rng.sample(FLIGHTS, rng.choice((1, 2, 5, 30)))
        removed = set(flights) if rng.random() < 0.1 else set()
        store.merge("raw_flights", {AIRCRAFT: flights}, rows(sorted(set(flights) - removed), n))
        expected = {f: k for f, k in expected.items() if f not in removed} | dict.fromkeys(set(flights) - removed, n)
        assert stored_rows(store) == sorted(expected.items())
        sample = rng.sample(FLIGHTS, 3)
        result = store.scan("raw_flights", [AIRCRAFT], sample).collect()["flight_id"]
        assert set(result) >= set(sample) & set(expected)
    assert len([name for name in names(store) if "-" in name]) <= OPEN


def test_a_flight_of_an_open_month_reads_no_other_file(tmp_path):
    merge(store := Store(tmp_path), FLIGHTS)
    assert set(store.scan("raw_flights", [AIRCRAFT], FLIGHTS[-2:]).collect()["flight_id"]) == set(FLIGHTS[-2:])


@pytest.mark.parametrize("months", [["2024-12"], ["2024-11", "2024-12"], ["2024"], ["2024-10", "2024-11", "2024-12"]])
def test_months_that_were_lost_come_back_once(tmp_path, months):
    """With the newest months gone, others are the newest: they stay in the year that has taken them in."""
    merge(store := Store(tmp_path), FLIGHTS)
    files = store.tables.shards("raw_flights")
    store.tables.remove_files("raw_flights", [files[f"AQX/LX-AAA/{name}"] for name in months])
    late = [f for f in FLIGHTS if "_202409" in f]
    merge(store, late, n=1)
    left = set(store.read_table("raw_flights")["flight_id"])
    merge(store, [f for f in FLIGHTS if f not in left], n=2)
    assert [flight for flight, _ in stored_rows(store)] == FLIGHTS
    assert {n for flight, n in stored_rows(store) if flight in late} == {1}


def test_a_year_that_was_lost_makes_its_flights_stale_and_no_others(tmp_path):
    store, ledger = Store(tmp_path / "home"), Ledger(tmp_path / "home")
    merge(store, FLIGHTS)
    done = [{"operator": "AQX", "tail": "LX-AAA", "flight_id": f, "version": "1"} for f in FLIGHTS]
    ledger.mark("raw_flights", pl.DataFrame(done))
    ledger.note_snapshot({"raw_flights": 0})
    file = store.tables.shards("raw_flights")["AQX/LX-AAA/2023"]
    (store.place.root / "raw_flights" / file).write_bytes(b"torn")
    repair_home(tmp_path / "landing", store, ledger)
    assert sorted(ledger.cells("raw_flights")["flight_id"]) == [f for f in FLIGHTS if "_2023" not in f]
    assert [flight for flight, _ in stored_rows(store)] == [f for f in FLIGHTS if "_2023" not in f]


def test_a_log_made_anew_from_all_files_counts_no_folded_month_twice(tmp_path):
    store, ledger = Store(tmp_path / "home"), Ledger(tmp_path / "home")
    for month in range(0, len(FLIGHTS), 2):
        merge(store, FLIGHTS[month : month + 2])
    ledger.note_snapshot({"raw_flights": store.tables.open("raw_flights").version()})
    for commit in (store.place.root / "raw_flights/_delta_log").iterdir():
        commit.unlink()
    repair_home(tmp_path / "landing", store, ledger)
    assert [flight for flight, _ in stored_rows(store)] == FLIGHTS
