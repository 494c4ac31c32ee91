"""Two workers with homes of their own make what one process makes, whoever dies, and no run is doubled.

Runs where HDT_TEST_POSTGRES and HDT_TEST_BROKER name a PostgreSQL server and a RabbitMQ that `rabbitmqctl` reaches. The
same on a larger fleet, through all steps and over addresses: benchmarks/distributed.py.
"""

import fcntl
import multiprocessing
import os
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from dagster_celery.tags import DAGSTER_CELERY_TASK_ID_TAG
from databases import SERVER
from nights import Silent, stages_of, unfolded

from benchmarks.fault_points import fingerprint
from hdt_core.simulate.design import FleetSettings
from pipelines.intake.simulated import write_fleet
from pipelines.orchestration import around_night, batches, nightly
from pipelines.orchestration.runs import EngineError

BROKER = os.environ.get("HDT_TEST_BROKER", "")
pytestmark = pytest.mark.skipif(
    not (SERVER and BROKER and shutil.which("rabbitmqctl")),
    reason="HDT_TEST_POSTGRES and HDT_TEST_BROKER name no PostgreSQL and RabbitMQ of this machine",
)


@pytest.fixture(scope="module")
def landing(tmp_path_factory) -> Path:
    """Four aircraft."""
    folder = tmp_path_factory.mktemp("fleet")
    list(write_fleet(folder, 3, FleetSettings(operators=2, tails=2, flights=12)))
    return folder / "landing"


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory, landing) -> Iterator:
    """Daemon and two workers; one site at a time, for a test restarts the broker."""
    from benchmarks.site import site

    with (
        (tmp_path_factory.getbasetemp().parent / "broker.lock").open("w") as lock,
        site(tmp_path_factory.mktemp("site"), landing, SERVER, BROKER) as machines,
    ):
        fcntl.flock(lock, fcntl.LOCK_EX)
        machines.daemon()
        for name in ("one", "two"):
            machines.worker(name)
        yield machines


@pytest.fixture(scope="module")
def alone(tmp_path_factory, landing) -> tuple[dict[str, str], int]:
    """Tables and number of runs of a night in one process, its ledger and its history below its home."""
    home = tmp_path_factory.mktemp("alone")
    with pytest.MonkeyPatch.context() as patch:
        small(patch)
        done = nightly.run_night(landing, home, Silent())
    assert not done.failed
    return fingerprint(home), done.runs


def small(patch: pytest.MonkeyPatch) -> None:
    """An aircraft a run; a step of four runs and one for the whole fleet."""
    patch.setattr(batches, "CELLS_A_RUN", 12)
    patch.setattr(nightly, "STAGES", unfolded(stages_of(2, 4)))


@pytest.fixture
def fleet(alone, elsewhere, monkeypatch):
    """The site, of which nothing is known yet; this process is its night's machine."""
    elsewhere.forget()
    for name, value in elsewhere.environment("night").items():
        monkeypatch.setenv(name, value)
    small(monkeypatch)
    for name in {"one", "two"} - set(elsewhere.processes):
        elsewhere.worker(name)
    return elsewhere


def is_at_a_run(fleet, name: str) -> bool:
    """A run has begun there and has not ended; one that is only received is the broker's, who gives it to another."""
    begun = "select value from run_tags join runs using (run_id) where key = %r and status = 'STARTED'"
    log = fleet.read_log(name).split(" ready.")[-1]
    return any(f"[{task}] received" in log for (task,) in fleet.rows(begun % DAGSTER_CELERY_TASK_ID_TAG))


def night_over(fleet) -> nightly.Night:
    home = fleet.home("night")
    with around_night.lock_home(home):
        return nightly.run_night(fleet.landing, home, Silent())


def test_two_workers_equal_one_process(fleet, alone):
    began = fleet.now()
    done = night_over(fleet)
    assert (done.failed, done.runs) == ({}, alone[1])
    assert fingerprint(fleet.home("night")) == alone[0]
    assert fleet.made_twice(began) == []
    assert all("execute_job" in fleet.read_log(name).split(" ready.")[-1] for name in ("one", "two"))
    assert not (fleet.home("night") / "ledger.sqlite").exists()


def test_killed_worker_loses_nothing(fleet, alone):
    from benchmarks.site import restart_broker, wait

    def strike() -> None:
        wait(lambda: is_at_a_run(fleet, "one"), 120, "the worker takes no run")
        fleet.kill("one")
        restart_broker()

    with ThreadPoolExecutor() as pool:
        struck = pool.submit(strike)
        done = night_over(fleet)
    struck.result()
    assert done.failed == {}
    assert fingerprint(fleet.home("night")) == alone[0]
    assert "no worker has been at it" in fleet.read_log("daemon")


def test_failed_aircraft_stops_no_other(fleet, monkeypatch):
    monkeypatch.setattr(batches, "CELLS_A_RUN", 24)  # two aircraft a run
    monkeypatch.setattr(nightly, "STAGES", stages_of(0, 1, nightly.STAGES))
    operator = sorted(fleet.landing.glob("*/*"))[0]
    in_the_way = Path(fleet.environment("night")["HDT_STORE_URL"], "raw_snapshots", *operator.parts[-2:])
    in_the_way.parent.mkdir(parents=True)
    in_the_way.touch()
    done = night_over(fleet)
    (where, why), *others = done.failed.items()
    assert others == []
    assert where == f"flights: {':'.join(operator.parts[-2:])}"
    assert "Not a directory" in why or "exists" in why
    assert fleet.rows("select count(distinct tail) from done where asset = 'raw_snapshots'") == [(3,)]


def _night(landing: Path, home: Path) -> None:
    """A night in a process that will be killed."""
    with pytest.MonkeyPatch.context() as patch:
        small(patch)
        with around_night.lock_home(home):
            nightly.run_night(landing, home, Silent())


def test_night_resumes_a_killed_one(fleet, alone):
    from benchmarks.site import wait

    began = fleet.now()
    other = fleet.home("other")
    first = multiprocessing.get_context("spawn").Process(target=_night, args=(fleet.landing, other))
    first.start()
    query = "select count(distinct tail) from done where asset = 'raw_flights'"

    def has_begun() -> bool:  # the ledger's tables are made by the first night that writes
        return fleet.rows("select to_regclass('done') is not null") == [(True,)] and fleet.rows(query) >= [(1,)]

    wait(lambda: has_begun() or not first.is_alive(), 60, "the first night does not begin")
    with pytest.raises(around_night.BusyError, match=rf"process {first.pid}\b"):
        night_over(fleet)
    first.kill()
    first.join()
    locks = "select 1 from pg_locks join pg_database as d on d.oid = database where locktype = 'advisory'"
    wait(lambda: not fleet.rows(f"{locks} and datname = current_database()"), 20, "the server does not notice the kill")
    done = night_over(fleet)
    assert done.failed == {}
    assert fingerprint(fleet.home("night")) == alone[0]
    assert fleet.made_twice(began) == []


def test_missing_daemon_is_named(fleet):
    fleet.kill("daemon")
    fleet.rows("delete from daemon_heartbeats")
    with pytest.raises(EngineError, match="no Dagster daemon answers; start one"):
        night_over(fleet)


def test_logs_hold_no_password(elsewhere):
    assert "guest:guest" not in "".join(elsewhere.read_log(name) for name in ("one", "two", "daemon"))
