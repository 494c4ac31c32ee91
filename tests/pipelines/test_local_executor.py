"""Blocks made side by side end as made one after the other; no worker outlives its night; history in PostgreSQL."""

import multiprocessing
import os
import signal
import sys
import time
from pathlib import Path

import dagster as dg
import pytest
from databases import SERVER, new_database
from nights import Silent, stages_of, unfolded

from benchmarks.fault_points import fingerprint
from hdt_core.simulate.design import FleetSettings
from pipelines.intake.simulated import write_fleet
from pipelines.orchestration import around_night, batches, local_executor, nightly
from pipelines.orchestration.runs import open_instance


@pytest.fixture(scope="module")
def landing(tmp_path_factory) -> Path:
    """Four aircraft."""
    folder = tmp_path_factory.mktemp("fleet")
    list(write_fleet(folder, 3, FleetSettings(operators=2, tails=2, flights=12)))
    return folder / "landing"


def run(landing: Path, home: Path, bars: Silent | None = None, **options: int) -> nightly.Night:
    with around_night.lock_home(home):
        return nightly.run_night(landing, home, bars or Silent(), **options)


@pytest.fixture
def small_blocks(monkeypatch) -> None:
    """An aircraft a run, shared out however few; up to the twin, whose fleet-wide steps are no different."""
    monkeypatch.setattr(batches, "CELLS_A_RUN", 12)
    monkeypatch.setattr(local_executor, "FLIGHTS_TO_SHARE", 1)
    monkeypatch.setattr(nightly, "STAGES", unfolded(stages_of(0, 5)))


def _eager_night(landing: Path, home: Path) -> None:
    """A night whose workers' modules make a query while they are loaded."""
    os.environ["PYTHONPATH"] = str(Path(__file__).parents[1] / "support")  # the forking process imports by it
    local_executor.WORKER = "eager_worker"
    local_executor.FLIGHTS_TO_SHARE = 1
    batches.CELLS_A_RUN = 12
    nightly.STAGES = unfolded(stages_of(0, 5))
    sys.exit(bool(run(landing, home, jobs=2).failed))


def test_query_at_import_does_not_hang(landing, tmp_path):
    """A fork has the locks of the engine's threads and none of the threads."""
    night = multiprocessing.get_context("spawn").Process(target=_eager_night, args=(landing, tmp_path))
    night.start()
    night.join(300.0)

    assert night.exitcode == 0


def test_two_processes_equal_one(landing, tmp_path, small_blocks, monkeypatch):
    """To the last digit: no flight's numbers hang on those it shares a run with."""
    counts = {}
    for jobs in (1, 2):
        night = run(landing, tmp_path / f"{jobs}", jobs=jobs)
        counts[jobs] = (night.runs, night.cells, night.failed)
    assert counts[2] == counts[1]
    assert not counts[1][2]
    monkeypatch.setattr(batches, "CELLS_A_RUN", 5)
    assert run(landing, tmp_path / "cut", jobs=2).runs > counts[1][0]
    assert fingerprint(tmp_path / "cut") == fingerprint(tmp_path / "2") == fingerprint(tmp_path / "1")


def test_night_recovers_from_dead_worker(landing, tmp_path, small_blocks):
    class Killer(Silent):
        """Kills a worker at the first block that is done."""

        def advance(self, cells: int) -> None:
            for child in multiprocessing.active_children():
                child.kill()

    night = run(landing, tmp_path, Killer(), jobs=2)
    assert "a worker process died" in next(iter(night.failed.values()))
    assert not run(landing, tmp_path).failed


@pytest.mark.parametrize(
    ("new", "past", "flights"), [(100, 700, 100), (100, 99_000, 6_600), (5_000, 5_000, 5_000), (0, 8_000, 8_000)]
)
def test_long_past_counts_as_work(new, past, flights):
    """A few late flights of many aircraft let features and alerts walk all that these have flown."""
    assert local_executor.equivalent_flights(new, past) == flights


def _night(landing: Path, home: Path) -> None:
    """A night in a process that will be killed; prints who works for it."""

    class Noter(Silent):
        def advance(self, cells: int) -> None:
            (home / "workers").write_text(" ".join(str(c.pid) for c in multiprocessing.active_children()))

    local_executor.FLIGHTS_TO_SHARE = 1
    batches.CELLS_A_RUN = 12
    nightly.STAGES = unfolded(nightly.STAGES)
    run(landing, home, Noter(), jobs=2)


def test_workers_die_with_their_night(landing, tmp_path):
    night = multiprocessing.get_context("spawn").Process(target=_night, args=(landing, tmp_path))
    night.start()
    pid_file = tmp_path / "workers"
    while not (pid_file.exists() and pid_file.read_text()):
        assert night.is_alive()
        time.sleep(0.05)
    os.kill(night.pid, signal.SIGKILL)
    night.join()
    pids = [int(pid) for pid in pid_file.read_text().split()]
    assert len(pids) == 2
    deadline = time.monotonic() + 10.0
    while any(_lives(pid) for pid in pids):
        assert time.monotonic() < deadline, "a worker outlived its night"
        time.sleep(0.05)


def _lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


SETTINGS = Path(__file__).parents[2] / "deploy/dagster.yaml"


def cells(instance: dg.DagsterInstance) -> dict[str, set[str]]:
    """Which cells of each asset have been made, by the instance's own account."""
    tables = [t for stage in stages_of(0, 5) if stage.grain == "flight" for t in stage.tables]
    return {t: set(instance.get_materialized_partitions(dg.AssetKey(t))) for t in tables}


@pytest.mark.skipif(not SERVER, reason="HDT_TEST_POSTGRES names no PostgreSQL server")
def test_postgres_records_night_like_sqlite(tmp_path, monkeypatch):
    list(write_fleet(tmp_path, 3, FleetSettings(operators=1, tails=2, flights=12)))
    monkeypatch.setattr(nightly, "STAGES", stages_of(0, 5))
    (tmp_path / "production/dagster").mkdir(parents=True)
    (tmp_path / "production/dagster/dagster.yaml").write_text(SETTINGS.read_text())
    recorded = []
    with new_database() as database:
        monkeypatch.setenv("HDT_POSTGRES_URL", database)
        for home in (tmp_path / "embedded", tmp_path / "production"):
            night = nightly.run_night(tmp_path / "landing", home, Silent())
            assert not night.failed, night.failed
            instance = open_instance(home)
            recorded.append((type(instance.event_log_storage).__name__, cells(instance)))
            instance.dispose()
    (embedded, first), (postgres, second) = recorded
    assert (embedded, postgres) == ("BatchedSqliteEventLogStorage", "BatchedPostgresEventLogStorage")
    assert first == second
    assert all(len(c) >= 20 for name, c in first.items() if name in {"raw_snapshots", "legs_samples", "twin_flights"})
