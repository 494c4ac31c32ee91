"""Asked to stop, a night ends at once: one line, the shells' exit codes, no process left, the home free again."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import polars as pl
import pytest
from dagster._core.errors import DagsterExecutionInterruptedError
from nights import run

from pipelines.assets import twin
from pipelines.cli.base import StoppedError, stop_in_order
from pipelines.definitions import build_defs
from pipelines.lineage import STAGE
from pipelines.orchestration.around_night import lock_home
from pipelines.orchestration.local_executor import block_stop_signals
from pipelines.orchestration.runs import open_instance
from pipelines.storage.files import replacing
from pipelines.storage.ledger import Ledger

SMALL = (
    "from pipelines.orchestration import batches, local_executor; batches.CELLS_A_RUN = 60;"
    " local_executor.FLIGHTS_TO_SHARE = 1; from pipelines.cli import main; main()"
)
LINE = "hdt: stopped; the next run continues from here\n"
CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}
QUICK_S = 10.0
"""What is stopped would go on for twice as long, on an idle machine; it ends in a second there."""


def start(*words: str, **where) -> subprocess.Popen[bytes]:
    """A command in a process group of its own, as a terminal starts it."""
    command = [sys.executable, "-c", SMALL, *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True, **where)


def group_of(process: subprocess.Popen) -> list[int]:
    """Processes of its group that live."""
    states = [f.read_text().rsplit(")", 1)[1].split() for f in Path("/proc").glob("[0-9]*/stat") if f.exists()]
    return [1 for state, _, group, *_ in states if int(group) == process.pid and state != "Z"]


def wait_for(process: subprocess.Popen, home: Path, asset: str) -> None:
    """Wait until the night has stored some of it."""
    while not (home / "ledger.sqlite").exists() or not Ledger(home, read_only=True).cells(asset).height:
        assert process.poll() is None, process.communicate()
        time.sleep(0.1)


def stop(process: subprocess.Popen, number: signal.Signals, group: bool = False) -> tuple[float, str]:
    """Ask it to stop: seconds it took, and its last line."""
    began = time.monotonic()
    (os.killpg if group else os.kill)(process.pid, number)
    _, stderr = process.communicate(timeout=60)
    return time.monotonic() - began, stderr.decode().splitlines(keepends=True)[-1]


@pytest.mark.parametrize(
    ("number", "jobs", "group", "after"),
    [
        (signal.SIGINT, 1, True, "raw_fleet"), (signal.SIGTERM, 1, False, "raw_messages"),
        (signal.SIGTERM, 2, False, "raw_flights"), (signal.SIGINT, 2, True, "raw_flights"),
    ],
)  # fmt: skip
def test_night_ends_at_once(sample_landing, tmp_path, number, jobs, group, after):
    home = tmp_path / "home"
    night = start("nightly", "--landing", str(sample_landing), "--home", str(home), "--jobs", str(jobs))
    wait_for(night, home, after)
    assert len(group_of(night)) >= jobs
    took_s, line = stop(night, number, group)
    assert (night.returncode, line) == (CODES[number], LINE)
    assert took_s < QUICK_S
    for _ in range(50):
        if not group_of(night):
            break
        time.sleep(0.1)
    assert group_of(night) == []
    assert not (home / "catalog.duckdb").exists()
    with lock_home(home):
        pass


@pytest.mark.parametrize("number", CODES)
def test_query_ends_at_once(sample_home, tmp_path, number):
    endless = "select count(*) from range(1000000) a, range(1000000) b where sin(a.range) > b.range + 2"
    process = start("query", "--home", str(sample_home), endless, env=os.environ | {"TMPDIR": str(tmp_path)})
    while not list(tmp_path.glob("hdt-*")):  # its catalog is open
        assert process.poll() is None, process.communicate()
        time.sleep(0.1)
    time.sleep(0.5)
    took_s, line = stop(process, number)
    assert (process.returncode, line) == (CODES[number], "hdt: stopped\n")
    assert took_s < QUICK_S
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def stale_home(own_home) -> tuple[Path, Path]:
    """Features have to be made again, and what depends on them."""
    landing, home = own_home
    ledger = Ledger(home)
    for table in STAGE["features"].tables:
        ledger.mark(table, ledger.cells(table).with_columns(version=pl.lit("")))
    (home / "catalog.duckdb").unlink()
    return landing, home


@pytest.fixture
def interrupted(monkeypatch):
    """The features' own step is where Ctrl-C comes."""
    monkeypatch.setattr(twin, "describe", lambda *_, **__: os.kill(os.getpid(), signal.SIGINT))


def test_no_step_follows_stopped_run(stale_home, interrupted):
    """Dagster catches the signal, calls the run a failure and would go on with the next."""
    landing, home = stale_home
    with pytest.raises(DagsterExecutionInterruptedError):
        run(landing, home)
    assert not (home / "catalog.duckdb").exists()


def test_night_stops_with_its_run(stale_home, interrupted):
    landing, home = stale_home
    with open_instance(home) as instance:
        job = build_defs(landing=landing, home=home).resolve_job_def("nightly")
        with pytest.raises(DagsterExecutionInterruptedError):
            job.execute_in_process(instance=instance)
    assert not (home / "catalog.duckdb").exists()
    with lock_home(home):
        pass


def _write_and_be_stopped(path: Path, number: signal.Signals) -> None:
    try:
        with replacing(path) as temporary:
            temporary.touch()
            signal.raise_signal(number)
    finally:
        assert list(path.parent.iterdir()) == []


@pytest.mark.parametrize("number", CODES)
def test_stopped_writer_tidies_up(number):
    with TemporaryDirectory() as folder, pytest.raises(StoppedError) as stopped, stop_in_order():
        _write_and_be_stopped(Path(folder, "report.html"), number)
    assert stopped.value.code == CODES[number]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def _wait_for_a_stop(connection) -> None:
    connection.send(signal.sigpending() | signal.pthread_sigmask(signal.SIG_BLOCK, ()))
    time.sleep(60)


def test_workers_ignore_stop_signals():
    here, there = multiprocessing.Pipe()
    with block_stop_signals():
        worker = multiprocessing.get_context("spawn").Process(target=_wait_for_a_stop, args=(there,), daemon=True)
        worker.start()
    assert {signal.SIGINT, signal.SIGTERM} <= here.recv()
    assert not {signal.SIGINT, signal.SIGTERM} & signal.pthread_sigmask(signal.SIG_BLOCK, ())
    worker.kill()
    worker.join()
