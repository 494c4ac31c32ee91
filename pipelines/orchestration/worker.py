"""Worker process of a night. Loaded once, by the process that all workers are forked from."""

import logging
import os
from collections.abc import Mapping
from functools import cache
from multiprocessing import parent_process
from pathlib import Path
from threading import Thread

import dagster as dg

from pipelines import assets
from pipelines.orchestration.batches import BatchResult, PartitionBatch
from pipelines.orchestration.runs import BY, Runner, open_instance
from pipelines.storage.ledger import Ledger

dg.load_assets_from_package_module(assets)  # loads the stages, the slowest part
_LOADING_PROCESS = os.getpid()


class LostPoolError(Exception):
    """The process lacks the threads of the one it was forked from, and its first query would wait for them for ever."""


def _has_pool() -> bool:
    """Return whether Polars' pool of threads runs, as after a query that a package makes while it is loaded."""
    return any(name.read_text() == "polars-0\n" for name in Path("/proc/self/task").glob("*/comm"))


_HAD_POOL = _has_pool()


def begin(environment: Mapping[str, str]) -> None:
    """Set the night's `environment`, which may be newer than the parent's, and exit when the night does."""
    logging.captureWarnings(True)
    os.environ.clear()
    os.environ.update(environment)
    Thread(target=_end_with_the_night, daemon=True).start()


def _end_with_the_night() -> None:
    """Exit once the night has ended, even killed: its lock is released, and another night may begin."""
    night = parent_process()
    if night is not None:
        night.join()
        os._exit(1)


def make(landing: Path, home: Path, tables: list[str], batch: PartitionBatch, label: str) -> BatchResult:
    """Make one batch by `Runner.make`.

    Raises
    ------
    LostPoolError
        This process was forked from one with Polars' threads.
    """
    if _HAD_POOL and os.getpid() != _LOADING_PROCESS:
        raise LostPoolError
    return _runner(landing, home).make(tables, batch, label)


@cache
def _runner(landing: Path, home: Path) -> Runner:
    """Build this process's runner, once."""
    return Runner(assets.asset_definitions(landing, home), open_instance(home), Ledger(home), BY)
