"""Cost of partitions and events alone: `python -m benchmarks.cells [--cells N ...] [--postgres URL] [--write]`.

One empty asset over aircraft x flight, ten years of flight keys, 10,000 cells an aircraft: no data, no table. The event
log is filled run by run of 1,000 cells through the project's own storage classes, SQLite and, where a server is named,
PostgreSQL. At each size some runs are real ones, executed and timed, and what the partitions page asks Dagster for is
asked. `--write` puts the table into docs/scale.md.
"""

import os
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any
from urllib.parse import urlsplit

import dagster as dg
import polars as pl
from dagster._core.definitions.partitions.utils.multi import get_tags_from_multi_partition_key
from dagster._core.events import StepMaterializationData
from dagster._core.events.log import EventLogEntry
from dagster._core.storage.partition_status_cache import get_and_update_asset_status_cache_value

from benchmarks.harness import Texts, machine, markdown, run
from benchmarks.scale import PAGE
from pipelines import resources
from pipelines.orchestration.batches import CELLS_A_RUN, PartitionBatch
from pipelines.orchestration.runs import BY, Runner, open_instance
from pipelines.resources import report
from pipelines.storage.ledger import Ledger

DAYS = [f"{2016 + day // 336}{day // 28 % 12 + 1:02}{day % 28 + 1:02}" for day in range(3334)]
FLIGHTS = [f"{day}_{leg:02}" for day in DAYS for leg in (1, 2, 3)][:10_000]
REAL_RUNS = 5
SERVER = os.environ.get("HDT_TEST_POSTGRES", "")
POSTGRES = """\
event_log_storage:
  module: dagster_batched.postgres
  class: BatchedPostgresEventLogStorage
  config: {{postgres_url: "{url}"}}
run_storage:
  module: dagster_postgres.run_storage
  class: PostgresRunStorage
  config: {{postgres_url: "{url}"}}
compute_logs:
  module: dagster._core.storage.noop_compute_log_manager
  class: NoOpComputeLogManager
telemetry: {{enabled: false}}
"""


class Nothing(dg.IOManager):
    """Stores nothing and reports the cells of the run, as the project's own manager does."""

    def handle_output(self, context: dg.OutputContext, obj: object) -> None:
        """Every cell of the range is filled."""
        rows = [*resources.cells_of(tuple(context.asset_partition_keys))]
        cells = pl.DataFrame(rows, schema=["operator", "tail", "flight_id"], orient="row")
        report(context, cells, cells)

    def load_input(self, context: dg.InputContext) -> None:
        """Nothing is there."""


@dg.asset(partitions_def=resources.AIRCRAFT_FLIGHTS, backfill_policy=dg.BackfillPolicy.single_run())
def empty() -> int:
    """An asset without data; something must be returned, or no IO manager is asked."""
    return 0


@dataclass
class History:
    """An instance, and how many bytes its storage takes."""

    instance: dg.DagsterInstance
    size_bytes: Callable[[], int]
    filled: int = 0

    def fill(self, cells: int, runner: Runner) -> None:
        """Fill cells up to a number, the last ones by timed runs."""
        event = None
        while self.filled < cells - REAL_RUNS * CELLS_A_RUN:
            event = event or self._example(runner)
            self._record(event, self._batch())
        self.run_s = [self._timed(lambda: self._run(runner)) for _ in range((cells - self.filled) // CELLS_A_RUN)]

    def _batch(self) -> PartitionBatch:
        """Return the next thousand cells."""
        first = self.filled % len(FLIGHTS)
        at = self.filled // len(FLIGHTS)
        self.filled += CELLS_A_RUN
        own = FLIGHTS[first : first + CELLS_A_RUN]
        return PartitionBatch(tuple((aircraft(at), f) for f in own), (own[0], own[-1]))

    def _run(self, runner: Runner) -> None:
        why = runner._run(["empty"], self._batch(), "empty")
        assert why is None, why

    def _example(self, runner: Runner) -> EventLogEntry:
        """Return a materialisation event of a real run."""
        self._run(runner)
        (run,) = self.instance.get_runs(limit=1)
        kind = dg.DagsterEventType.ASSET_MATERIALIZATION
        return next(iter(self.instance.all_logs(run.run_id, of_type=kind)))

    def _record(self, event: EventLogEntry, batch: PartitionBatch) -> None:
        """Store the event as if a run had made the batch."""
        keys = resources.cell_keys(batch.cells)
        tags = get_tags_from_multi_partition_key(keys[0])
        materialization = dg.AssetMaterialization("empty", partition=keys[0], tags=tags)
        dagster_event = event.get_dagster_event()._replace(event_specific_data=StepMaterializationData(materialization))
        log = self.instance.event_log_storage
        run_id = str(uuid.uuid4())
        log.group_partitions(run_id, empty.key, keys)
        log.store_event_batch([event._replace(run_id=run_id, dagster_event=dagster_event)])

    @staticmethod
    def _timed(call: Callable[[], Any]) -> float:
        began = time.perf_counter()
        call()
        return time.perf_counter() - began

    def row(self) -> dict[str, float]:
        """Measure run time, storage per cell and response time of the partitions page."""
        loader = {"partitions_def": resources.AIRCRAFT_FLIGHTS, "dynamic_partitions_loader": self.instance}

        def status() -> None:
            status_cache = get_and_update_asset_status_cache_value(self.instance, empty.key, **loader)
            subset = status_cache.deserialize_materialized_partition_subsets(resources.AIRCRAFT_FLIGHTS)
            assert len(subset) == self.filled, len(subset)

        first = self._timed(status)
        return {
            "cells": self.filled,
            "run_s": median(self.run_s),
            "bytes": self.size_bytes() / self.filled,
            "page_first_s": first,
            "page_again_s": self._timed(status),
            "all_s": self._timed(lambda: self.instance.get_materialized_partitions(empty.key)),
        }


def aircraft(n: int) -> str:
    """Key of an aircraft."""
    return resources.aircraft_key("QAA", f"T{n:04}")


@contextmanager
def sqlite(scratch: Path) -> Iterator[History]:
    """The embedded default."""
    instance = open_instance(scratch / "sqlite")
    yield History(instance, lambda: sum(f.stat().st_size for f in (scratch / "sqlite").rglob("*") if f.is_file()))
    instance.dispose()


@contextmanager
def on_server(scratch: Path, server: str) -> Iterator[History]:
    """A database of its own on a server, dropped in the end."""
    import psycopg2  # noqa: PLC0415  the extra postgres

    name = f"hdt_cells_{uuid.uuid4().hex}"
    admin = psycopg2.connect(server)
    admin.autocommit = True
    cursor = admin.cursor()
    cursor.execute(f"create database {name}")
    settings = scratch / "postgres/dagster/dagster.yaml"
    settings.parent.mkdir(parents=True)
    settings.write_text(POSTGRES.format(url=urlsplit(server)._replace(path=f"/{name}").geturl()))
    instance = open_instance(scratch / "postgres")

    def size_bytes() -> int:
        cursor.execute("select pg_database_size(%s)", (name,))
        return int(cursor.fetchone()[0])

    try:
        yield History(instance, size_bytes)
    finally:
        instance.dispose()
        cursor.execute(f"drop database {name} with (force)")
        admin.close()


def measured(history: History, sizes: list[int]) -> list[dict[str, float]]:
    """Return a row per size."""
    defs = dg.Definitions([empty], resources={"io_manager": Nothing()}, executor=dg.in_process_executor)
    runner = Runner(defs, history.instance, Ledger(Path()), BY)
    keys = [aircraft(n) for n in range(max(sizes) // len(FLIGHTS) + 1)]
    add = history.instance.add_dynamic_partitions
    registered = history._timed(lambda: (add("aircraft", keys), add("flight", FLIGHTS)))
    rows = []
    for size in sizes:
        history.fill(size, runner)
        row = history.row() | {"register_s": registered}
        print(row, flush=True)
        rows.append(row)
    return rows


def table(results: dict[str, list[dict[str, float]]]) -> str:
    """Return the table as Markdown."""
    head = ["event log", "cells", "a run of 1,000 [s]", "bytes a cell", "status of all cells, first [s]", "again [s]"]
    lines = [[*head, "all made cells [s]"]]
    for name, rows in results.items():
        for r in rows:
            seconds = (f"{r[c]:.2f}" for c in ("page_first_s", "page_again_s", "all_s"))
            lines.append([name, f"{r['cells']:,}", f"{r['run_s']:.2f}", f"{r['bytes']:.0f}", *seconds])
    times = ", ".join(f"{rows[0]['register_s']:.1f} s in {name}" for name, rows in results.items())
    return f"{markdown(lines)}\n\nRegistering {len(FLIGHTS):,} flight keys and the aircraft: {times}.\n{machine()}"


def main(cells: tuple[int, ...] = (10_000, 100_000, 1_000_000), postgres: str = SERVER) -> Texts:
    """Histories of so many cells in SQLite and, where its URL is given, on a server."""
    results = {}
    with tempfile.TemporaryDirectory() as scratch:
        with sqlite(Path(scratch)) as history:
            results["SQLite"] = measured(history, list(cells))
        if postgres:
            with on_server(Path(scratch), postgres) as history:
                results["PostgreSQL"] = measured(history, list(cells))
    yield "cells", table(results)


if __name__ == "__main__":
    run(main, page=PAGE)
