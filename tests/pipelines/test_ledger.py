"""The ledger says the same from SQLite below the home and from a PostgreSQL database; one night at a time holds either.

PostgreSQL where HDT_TEST_POSTGRES names a server, as `postgresql://user@host:5432/database`.
"""

import multiprocessing
import os
import shutil
import sqlite3
import subprocess
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import closing, nullcontext
from pathlib import Path

import polars as pl
import pytest
from command import command_line
from databases import SERVER, new_database

from pipelines.orchestration import around_night
from pipelines.storage import database
from pipelines.storage.ledger import FILE, NAMES, Ledger

A = ("AQX", "LX-AAA")
B = ("AQX", "LX-AAB")
FILES = [("a/1.csv", *A, "acms", 2**40, 2**62, "d1"), ("a/m.csv", *A, "messages", 1, 1, "d2"),
         ("b/1.csv", *B, "acms", 1, 1, "d3")]  # fmt: skip
HOLDINGS = {
    "a/1.csv": [(*A, "LX-AAA_20240101_01"), (*A, "LX-AAA_20240102_01")],
    "b/1.csv": [(*B, "LX-AAB_20240101_01")],
}


@pytest.fixture(params=["sqlite", "postgresql"])
def ledger(request, tmp_path, monkeypatch) -> Iterator[Ledger]:
    """A ledger that knows three files of two aircraft."""
    if request.param == "postgresql" and not SERVER:
        pytest.skip("HDT_TEST_POSTGRES names no PostgreSQL server")
    with new_database() if request.param == "postgresql" else nullcontext("") as url:
        monkeypatch.setenv(database.URL, url)
        ledger = Ledger(tmp_path)
        ledger.register(FILES, HOLDINGS)
        yield ledger
        assert (tmp_path / "ledger.sqlite").exists() == (not url)


def _cells(*rows: tuple[str, str, str, str]) -> pl.DataFrame:
    return pl.DataFrame(rows, schema=["operator", "tail", "flight_id", "version"], orient="row")


@pytest.mark.parametrize(
    ("first", "second", "waits"), [(True, True, False), (True, False, True), (False, True, True), (False, False, True)]
)
def test_shared_turns_overlap(ledger, first, second, waits):
    """Turns that both share overlap; a turn alone waits for every other, and they for it."""

    def store() -> None:
        with ledger.turn(shared=second):
            pass

    with ThreadPoolExecutor(1) as pool:
        with ledger.turn(shared=first):
            other = pool.submit(store)
            done, _ = wait([other], timeout=0.3 if waits else 30)
            assert bool(done) != waits
        other.result(30)


def test_ledger_lists_registered_files(ledger):
    sizes_and_times = {path: record[:2] for path, record in ledger.file_records().items()}
    assert sizes_and_times == {"a/1.csv": (2**40, 2**62), "a/m.csv": (1, 1), "b/1.csv": (1, 1)}


def test_files_are_read_by_kind(ledger):
    paths = [ledger.files(kinds)["path"].sort().to_list() for kinds in (["acms", "cpl"], [])]
    assert paths == [["a/1.csv", "b/1.csv"], []]
    assert ledger.files(["acms"]).schema["mtime_ns"] == pl.Int64


def test_flights_name_their_files(ledger):
    assert ledger.flight_inputs().sort("flight_id").rows()[0] == (*A, "LX-AAA_20240101_01", "a/1.csv=d1")
    assert ledger.flight_files().height == 3


def test_nights_stand_in_order(ledger):
    for k in range(12):
        ledger.note_night(("2024-01-01", "2024-01-01", k, 0, 0, 0, "{}"))
    assert ledger.nights()["files"].to_list() == [str(k) for k in range(12)]


def test_changed_file_replaces_its_record(ledger):
    """And adds to its flights."""
    ledger.register([("a/1.csv", *A, "acms", 9, 9, "new")], {"a/1.csv": [(*A, "LX-AAA_20240103_01")]})
    assert ledger.file_records()["a/1.csv"][:2] == (9, 9)
    flight_inputs = ledger.flight_inputs().filter(pl.col("tail") == A[1])
    assert flight_inputs["line"].unique().to_list() == ["a/1.csv=new"]
    assert flight_inputs.height == 3


def test_remarked_cell_has_last_version(ledger):
    ledger.mark("raw_flights", _cells((*A, "f1", "v1"), (*A, "f2", "v1"), (*A, "f2", "v2")))
    ledger.mark("raw_flights", _cells((*A, "f1", "v3")))
    ledger.mark("legs_samples", _cells((*A, "f1", "other")))
    assert ledger.cells("raw_flights").sort("flight_id")["version"].to_list() == ["v3", "v2"]
    ledger.mark("raw_flights", _cells())
    assert ledger.cells("raw_flights").height == 2


def test_run_reads_own_aircraft(ledger):
    """And the fleet's."""
    ledger.mark("raw_flights", _cells((*A, "f1", "v1"), (*B, "f1", "v1"), ("", "", "", "fleet")))
    own = ledger.of([A])
    assert set(own.cells("raw_flights")["tail"]) == {A[1], ""}
    assert set(own.flight_inputs()["tail"]) == {A[1]}
    assert own.files(["acms"])["path"].to_list() == ["a/1.csv"]


def test_run_reads_own_flights(ledger):
    cells = pl.DataFrame({"operator": "AAA", "tail": "T1", "flight_id": list("abc"), "version": list("123")})
    ledger.mark("legs_samples", cells)
    assert ledger.of([("AAA", "T1")], ["b", "x"]).cells("legs_samples").rows() == [("AAA", "T1", "b", "2")]
    assert ledger.of([("AAA", "T1")], map(str, range(20_000))).cells("legs_samples").height == 3


def test_failed_mark_leaves_nothing(ledger, monkeypatch):
    def fail(event: str, *_: object) -> None:
        if event.startswith("hdt."):
            raise OSError(event)

    monkeypatch.setattr("sys.audit", fail)
    with pytest.raises(OSError, match="before_mark"):
        ledger.mark("raw_flights", _cells((*A, "f1", "v1")))
    assert ledger.cells("raw_flights").is_empty()


def _hold(home: Path, ready, over) -> None:
    with around_night.lock_home(home):
        ready.set()
        over.wait()


def test_lock_ends_with_its_process(ledger, tmp_path):
    """Until then there is one night at a time, though homes differ: a second home stands for a second machine; without
    a common database each home is a fleet of its own."""
    spawn = multiprocessing.get_context("spawn")
    ready = spawn.Event()
    over = spawn.Event()
    first = spawn.Process(target=_hold, args=(tmp_path / "one", ready, over))
    first.start()
    assert ready.wait(30)
    other = tmp_path / ("two" if ledger.url else "one")
    with (
        pytest.raises(around_night.BusyError, match=rf"process {first.pid}\b.*wait for it to end"),
        around_night.lock_home(other),
    ):
        pass
    first.kill()
    first.join()
    for _ in range(100):  # the server notices the broken connection
        try:
            with around_night.lock_home(other):
                return
        except around_night.BusyError:
            time.sleep(0.05)
    pytest.fail("the lock outlived its process")


@pytest.mark.parametrize("read_only", [True, False])
def test_ledger_without_tables_is_empty(tmp_path, read_only):
    with closing(sqlite3.connect(tmp_path / FILE)) as con:
        con.execute("pragma journal_mode=wal")
    assert (tmp_path / FILE).stat().st_size
    assert Ledger(tmp_path, url="", read_only=read_only).file_records() == {}


SECRET = "s3cr3t-word"


@pytest.mark.parametrize(
    ("url", "message"),
    [
        (f"postgresql://hdt:{SECRET}@127.0.0.1:1/none", r"ledger's database at 127\.0\.0\.1:1/none .* does not answer"),
        (f"postgres//hdt:{SECRET}@somewhere", "no address of the form postgresql://"),
        (f"postgresql://hdt:{SECRET}@127.0.0.1:none/x", "no address of the form postgresql://|does not answer"),
    ],
)
def test_silent_database_hides_the_password(url, message, tmp_path, monkeypatch):
    pytest.importorskip("psycopg2")
    monkeypatch.setenv(database.URL, url)
    ledger = Ledger(tmp_path)
    with pytest.raises(database.DatabaseError, match=message) as error:
        ledger.file_records()
    with pytest.raises(database.DatabaseError), around_night.lock_home(tmp_path):
        pass
    assert SECRET not in f"{error.value!r} {ledger!r}"
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("variable", "message"),
    [
        (database.URL, "hdt: the ledger's database at 127.0.0.1:1/none"),
        ("HDT_POSTGRES_URL", "hdt: the database of Dagster's history (dagster.yaml) does not answer: connection to"),
    ],
)
def test_command_names_silent_database(variable, message, tmp_path):
    pytest.importorskip("psycopg2")
    for folder in ("landing", "home/dagster"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "landing/fleet.csv").touch()
    shutil.copy(Path(__file__).parents[2] / "deploy/dagster.yaml", tmp_path / "home/dagster")
    command = command_line("nightly", "--landing", tmp_path / "landing", "--home", tmp_path / "home")
    wrong = os.environ | {variable: f"postgresql://hdt:{SECRET}@127.0.0.1:1/none"}
    done = subprocess.run(command, env=wrong, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith(message)
    assert "Traceback" not in done.stderr
    assert SECRET not in done.stderr + done.stdout


def test_changed_cells_last_until_settled(ledger):
    one, two = (("AAA/T1/acms/x.csv", "AAA", "T1", "acms", 1, 1, d) for d in "de")
    ledger.register([one], {one[0]: [(*one[1:3], "T1_20260101_01")]})
    assert (ledger.settled_version(), ledger.changed_cells().rows()) == (None, [])  # any cell may be stale
    ledger.settle("so")
    ledger.register([two], {two[0]: [(*two[1:3], "T1_20260101_01")]})
    assert ledger.settled_version() == "so"
    assert set(ledger.changed_cells().rows()) == {("AAA", "T1", ""), ("AAA", "T1", "T1_20260101_01")}


def test_ledger_settles_one_version(ledger):
    ledger.settle("so")
    assert [ledger.is_settled(version) for version in ("so", "otherwise")] == [True, False]


@pytest.mark.parametrize(
    "change",
    [
        lambda ledger: ledger.delete_cells(["features"], ("AAA", "T1")),
        lambda ledger: ledger.mark("features", _cells((*A, "", "1"))),
    ],
    ids=["deleted", "marked"],
)
def test_changed_cells_end_settlement(ledger, change):
    ledger.settle("so")
    change(ledger)
    assert ledger.settled_version() is None
    assert not ledger.is_settled("so")


def test_aircraft_cells_make_one_text(ledger):
    """Of each aircraft its own, also where one's name begins as another's does."""
    for tail in ("T1", "T10"):
        cells = pl.DataFrame({"operator": "AAA", "tail": tail, "flight_id": list("ba"), "version": list("12")})
        ledger.mark("raw_flights", cells)
    by_tail = {tail: sorted(lines.split("|")) for _, tail, lines in ledger.lines("raw_flights").rows()}
    assert by_tail == {tail: [f"AAA={tail}=a=2", f"AAA={tail}=b=1"] for tail in ("T1", "T10")}
    assert ledger.of([("AAA", "T1")]).lines("raw_flights")["tail"].to_list() == ["T1"]


def test_table_without_cells_has_no_text(ledger):
    assert ledger.lines("legs_samples").is_empty()


def test_table_names_differ_from_dagsters():
    """In PostgreSQL both may live in one database, where `create table if not exists` would take the other's."""
    from dagster._core.storage.event_log.schema import SqlEventLogStorageMetadata
    from dagster._core.storage.runs.schema import RunStorageSqlMetadata
    from dagster._core.storage.schedules.schema import ScheduleStorageSqlMetadata

    theirs = [*SqlEventLogStorageMetadata.tables, *RunStorageSqlMetadata.tables, *ScheduleStorageSqlMetadata.tables]
    assert "snapshots" in theirs
    assert set(NAMES).isdisjoint(theirs)
