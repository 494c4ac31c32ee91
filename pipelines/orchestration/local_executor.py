"""Batches of one step side by side, a process a core: only where there are enough of them to pay for its start."""

from __future__ import annotations

import ctypes
import os
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import cache
from multiprocessing import get_context, resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # Dagster takes seconds to load, and a night with nothing new needs none of it
    from pipelines.orchestration.batches import BatchResult, PartitionBatch
    from pipelines.orchestration.runs import Runner

BLOCKS_TO_SHARE = 3  # a process takes four seconds to start, a full block ten to make
_SET_PARENT_DEATH_SIGNAL = 1


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0))


class EngineError(Exception):
    """Runs can't be sent out to other machines; says why and what to do, in one line."""


def sends_out(home: Path) -> bool:
    """Whether the home's `dagster.yaml` names a launcher of runs; read as text, for Dagster takes seconds to load."""
    settings = home / "dagster" / "dagster.yaml"
    return settings.exists() and any(line.startswith("run_launcher:") for line in settings.read_text().splitlines())


class LocalExecutor:
    """Processes that make batches of one home; started when there is first something to share out."""

    ranges = False  # few large runs of whole aircraft cost one machine least, and its processes are handed any cells

    def __init__(self, landing: Path, home: Path, jobs: int) -> None:
        self.landing, self.home, self.jobs = landing.resolve(), home.resolve(), jobs
        self._pool: ProcessPoolExecutor | None = None

    def worth(self, batches: list[PartitionBatch], few: bool) -> bool:
        """Whether the batches are enough to share out; not where there is little new in each of a few."""
        return not few and self.jobs > 1 and len(batches) >= BLOCKS_TO_SHARE

    def make(self, tables: list[str], batches: list[PartitionBatch], label: str) -> Iterator[BatchResult]:
        """Make the batches in any order and say of each when it is done.

        A worker that dies, for want of memory say, takes the step with it: the night says so and the next one goes on.
        """
        pool = self._ready()
        try:
            with deaf():  # it is a submission that starts a process
                made = [pool.submit(_make, self.landing, self.home, tables, b, label) for b in batches]
            for future in as_completed(made):
                yield future.result()
        except BrokenProcessPool:
            from pipelines.orchestration.batches import BatchResult

            self._pool = None
            yield BatchResult(0, 0, {label: "a worker process died; fewer at once may help: --jobs 1"})

    def _ready(self) -> ProcessPoolExecutor:
        if self._pool is None:
            self._pool = ProcessPoolExecutor(self.jobs, get_context("spawn"), _die_with, (os.getpid(),))
        return self._pool

    def stop(self) -> None:
        """Let the processes end, and what they hold in memory with them; there will be others when there is need."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None


@contextmanager
def workers(landing: Path, home: Path, jobs: int) -> Iterator[LocalExecutor]:
    """A `LocalExecutor` that ends with the block."""
    ours = LocalExecutor(landing, home, jobs)
    try:
        yield ours
    finally:
        ours.stop()


@contextmanager
def deaf() -> Iterator[None]:
    """Processes started within the block hear no stop signal: who started them, whom Ctrl-C reaches too, ends them."""
    resource_tracker.ensure_running()  # the first process starts it, and it would open the ears of the next
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _die_with(parent: int) -> None:
    """End when the night does, however it ends: once killed it holds its home no longer, and another may begin."""
    ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def _make(landing: Path, home: Path, tables: list[str], batch: PartitionBatch, label: str) -> BatchResult:
    return _runner(landing, home).make(tables, batch, label)


@cache
def _runner(landing: Path, home: Path) -> Runner:
    """This worker's own."""
    from pipelines.assets.location import asset_definitions
    from pipelines.orchestration.runs import BY, Runner, open_instance
    from pipelines.storage.ledger import Ledger

    return Runner(asset_definitions(landing, home), open_instance(home), Ledger(home), BY)
