"""Batches of one step side by side, a process a core: only where there are enough of them to pay for its start."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import forkserver, get_context, resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # Dagster takes seconds to load, and a night with nothing new needs none of it
    from pipelines.orchestration.batches import BatchResult, PartitionBatch

FLIGHTS_TO_SHARE = 2_000  # a second process takes as long to load as a thousand flights to read
PAST_TO_A_FLIGHT = 15  # flights of an aircraft's past that cost as much as a new one: its features are made again
WORKER = "pipelines.orchestration.worker"


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
        # not forked from this process, whose threads a fork would lose, but from one that has loaded what they need
        self._forked = get_context("forkserver")
        self._forked.set_forkserver_preload([WORKER])
        self._pool: ProcessPoolExecutor | None = None

    def among(self, flights: int) -> int:
        """How many processes share so many new flights: several only where that pays for their start."""
        return self.jobs if flights >= FLIGHTS_TO_SHARE else 1

    def expect(self, flights: int) -> None:
        """Begin to load what processes are forked from, if so many flights will be shared out: it takes seconds."""
        if self.among(flights) > 1:
            with deaf():
                forkserver.ensure_running()

    def worth(self, batches: list[PartitionBatch], flights: int) -> bool:
        """Whether batches of so many new flights are shared out."""
        return len(batches) > 1 and self.among(flights) > 1

    def make(self, tables: list[str], batches: list[PartitionBatch], label: str) -> Iterator[BatchResult]:
        """Make the batches in any order and say of each when it is done.

        A worker that dies, for want of memory say, takes the step with it: the night says so and the next one goes on.
        """
        from pipelines.orchestration import worker

        try:
            with deaf():  # it is a submission that starts a process
                if self._pool is None:
                    self._pool = ProcessPoolExecutor(self.jobs, self._forked, worker.begin, (dict(os.environ),))
                made = [self._pool.submit(worker.make, self.landing, self.home, tables, b, label) for b in batches]
            for future in as_completed(made):
                yield future.result()
        except BrokenProcessPool:
            from pipelines.orchestration.batches import BatchResult

            self._pool = None
            yield BatchResult(0, 0, {label: "a worker process died; fewer at once may help: --jobs 1"})

    def stop(self) -> None:
        """Let the processes end, and what they hold in memory with them; there will be others when there is need."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None


def work(new: int, past: int) -> int:
    """New flights that cost as much as these and all that their aircraft have flown; the past alone where none is."""
    return max(new, past // PAST_TO_A_FLIGHT) if new else past


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
