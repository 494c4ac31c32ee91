"""Run batches of one step in parallel, a process a core, where they are enough to pay for its start."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import forkserver, get_context, resource_tracker
from multiprocessing.context import BaseContext
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.storage.settings import dagster_settings

if TYPE_CHECKING:  # Dagster takes seconds to load, and a night with nothing new needs none of it
    from pipelines.orchestration.batches import BatchResult, PartitionBatch

FLIGHTS_TO_SHARE = 2_000  # a second process takes as long to load as a thousand flights to read
PAST_TO_A_FLIGHT = 15  # flights of an aircraft's past that cost as much as a new one: its features are made again
WORKER = "pipelines.orchestration.worker"


def cores() -> int:
    """Count cores that this process may use."""
    return len(os.sched_getaffinity(0))


def sends_out(home: Path) -> bool:
    """Check whether the home's `dagster.yaml` names a run launcher; read as text, for Dagster takes seconds to load."""
    return any(line.startswith("run_launcher:") for line in dagster_settings(home).splitlines())


class LocalExecutor:
    """Processes that make batches of one home, started with the first batch."""

    ranges = False  # few large runs of whole aircraft cost one machine least, and its processes are handed any cells

    def __init__(self, landing: Path, home: Path, jobs: int) -> None:
        self.landing, self.home, self.jobs = landing.resolve(), home.resolve(), jobs
        # not forked from this process, whose threads a fork would lose, but from one that has loaded what they need
        self._context: BaseContext = get_context("forkserver")
        self._context.set_forkserver_preload([WORKER])
        self._pool: ProcessPoolExecutor | None = None

    def process_count(self, flights: int) -> int:
        """Return the number of processes for so many new flights: several only where that pays for their start."""
        return self.jobs if flights >= FLIGHTS_TO_SHARE else 1

    def prepare(self, flights: int) -> None:
        """Preload the process that workers are forked from, which takes seconds, if so many flights need several."""
        if self.process_count(flights) > 1:
            with block_stop_signals():
                forkserver.ensure_running()

    def should_distribute(self, batches: list[PartitionBatch], flights: int) -> bool:
        """Check whether batches of so many new flights go to several processes."""
        return len(batches) > 1 and self.process_count(flights) > 1

    def make(self, tables: list[str], batches: list[PartitionBatch], label: str) -> Iterator[BatchResult]:
        """Make the batches in any order and yield each result when it is ready.

        A worker that dies, as when memory runs out, fails the step; the night reports it and the next one goes on.
        """
        from pipelines.orchestration.worker import LostPoolError

        try:
            yield from self._results(tables, batches, label)
        except LostPoolError:  # of every batch: a package makes a query while it is loaded, so each worker loads it
            self.close()
            self._context = get_context("spawn")
            yield from self._results(tables, batches, label)

    def _results(self, tables: list[str], batches: list[PartitionBatch], label: str) -> Iterator[BatchResult]:
        from pipelines.orchestration import worker

        try:
            with block_stop_signals():  # a submission starts the process
                if self._pool is None:
                    self._pool = ProcessPoolExecutor(self.jobs, self._context, worker.begin, (dict(os.environ),))
                futures = [self._pool.submit(worker.make, self.landing, self.home, tables, b, label) for b in batches]
            for future in as_completed(futures):
                yield future.result()
        except BrokenProcessPool:
            from pipelines.orchestration.batches import BatchResult

            self._pool = None
            yield BatchResult(0, 0, {label: "a worker process died; fewer at once may help: --jobs 1"})

    def close(self) -> None:
        """End the processes and release their memory; the next batch starts new ones."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None


def equivalent_flights(n_new: int, n_past: int) -> int:
    """Convert new and past flights into as many new ones of equal cost; without new flights, count the past."""
    return max(n_new, n_past // PAST_TO_A_FLIGHT) if n_new else n_past


@contextmanager
def block_stop_signals() -> Iterator[None]:
    """Start processes with SIGINT and SIGTERM blocked; their parent, which Ctrl-C reaches too, ends them."""
    resource_tracker.ensure_running()  # the first process would start it, which unblocks the signals for the next
    old_mask = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, old_mask)
