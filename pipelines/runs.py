"""Dagster runs: where they are recorded, one run of a block of cells, what failed."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dagster as dg
import polars as pl
from dagster._core.definitions.job_base import InMemoryJob
from dagster._core.errors import DagsterExecutionInterruptedError
from dagster._core.events import RunFailureReason
from dagster._core.execution.api import execute_run

from pipelines import partitions
from pipelines.blocks import Block, Known, Made, by_aircraft
from pipelines.eventlog import batch_events
from pipelines.ledger import Ledger
from pipelines.series import OneForMany

# a line on the console for every event would cost more than storing it; the run's page has them all
_QUIET = {"loggers": {"console": {"config": {"log_level": "CRITICAL"}}}}
NIGHT = {"hdt/night": "yes"}  # a run of the chain, and none that someone started from the page
MOST_PINNED = 3
_OURS = "# Written by hdt."
_INSTANCE = """\
# Written by hdt. Delete this line to make the file yours. Everything lies below this folder; nothing is sent anywhere.
telemetry:
  enabled: false
nux:
  enabled: false
freshness:
  enabled: true
compute_logs:  # the assets print nothing, and catching what they print would start two processes a step
  module: dagster._core.storage.noop_compute_log_manager
  class: NoOpComputeLogManager
event_log_storage:
  module: pipelines.eventlog
  class: BatchedSqliteEventLogStorage
  config:
    base_dir: {base}/history
"""


def open_instance(home: Path) -> dg.DagsterInstance:
    """Dagster's own storage below `<home>/dagster`; a `dagster.yaml` the user put there is used as it is."""
    batch_events()
    partitions.leave_cells_unlisted()
    base = home.resolve() / "dagster"
    base.mkdir(parents=True, exist_ok=True)
    settings, ours = base / "dagster.yaml", _INSTANCE.format(base=base)
    if not settings.exists() or settings.read_text().startswith(_OURS):  # a home may have been moved
        settings.write_text(ours)
    return dg.DagsterInstance.from_config(str(base))


@dataclass(frozen=True, slots=True)
class Runner:
    """Runs selections of the location's assets."""

    defs: dg.Definitions
    instance: dg.DagsterInstance
    ledger: Ledger

    def bury(self) -> None:
        """Mark as failed what a killed night left: its runs would stay STARTED for ever.

        Only for who has just taken the home's lock: none of them can be alive.
        """
        begun = [dg.DagsterRunStatus.NOT_STARTED, dg.DagsterRunStatus.STARTING, dg.DagsterRunStatus.STARTED]
        for run in self.instance.get_runs(dg.RunsFilter(statuses=begun, tags=NIGHT)):
            self.instance.report_run_failed(run, "the process was stopped; the next night made what was missing")

    def register(self, cells: pl.DataFrame) -> None:
        """Make a partition of every new aircraft and flight (operator, tail, flight_id), in order of departure."""
        aircraft = {partitions.aircraft_key(o, t) for o, t in cells.select("operator", "tail").unique().rows()}
        flights = {partitions.flight_key(f) for f in cells["flight_id"].unique() if f}
        for definition, keys in ((partitions.AIRCRAFT, aircraft), (partitions.FLIGHTS, flights)):
            new = sorted(keys - set(self._keys(definition)))
            if new:
                self.instance.add_dynamic_partitions(str(definition.name), new)

    def known(self) -> Known:
        """Partitions as they are now, and who flew which."""
        aircraft, flights = (self._keys(d) for d in (partitions.AIRCRAFT, partitions.FLIGHTS))
        return Known(aircraft, flights, by_aircraft(self.ledger.flight_files()))

    def _keys(self, definition: dg.DynamicPartitionsDefinition) -> list[str]:
        return list(self.instance.get_dynamic_partitions(str(definition.name)))

    def make(self, tables: list[str], block: Block, label: str) -> Made:
        """One run. If it fails, each of its aircraft alone, and of one aircraft halves: one flight stops no other."""
        why = self._run(tables, block)
        if why is None:
            return Made(block, 1, {})
        if len(block.aircraft) < 2:
            runs, told = self._pinned_down(tables, block, why)
            return Made(block, 1 + runs, {f"{label}: {block.aircraft[0] if block.aircraft else 'fleet'}": told})
        alone = [self.make(tables, one, label) for one in block.apart()]
        failed = {where: why for one in alone for where, why in one.failed.items()}
        return Made(block, 1 + sum(one.runs for one in alone), failed)

    def _pinned_down(self, tables: list[str], block: Block, why: str) -> tuple[int, str]:
        """Make what can be made of an aircraft's block that failed, half by half; how many runs, and what fails why.

        After `MOST_PINNED` flights the rest is left as it is: then it is not the flights.
        """
        left, runs, told = [(block, why)], 0, list[str]()
        while left:
            one, why = left.pop()
            halves = self.known().halves(one) if len(told) < MOST_PINNED else []
            if not halves:
                told.append(self._named(one, why))
            runs += len(halves)
            left += [(half, why) for half in reversed(halves) if (why := self._run(tables, half))]
        return runs, "; ".join(told)

    def _named(self, block: Block, why: str) -> str:
        """Why a block failed, with the flight and its files, or the first and last of its flights."""
        if not block.first:
            return why
        if block.first != block.last:
            return f"flights {block.first} to {block.last}: {why}"
        aircraft = partitions.aircraft_of(block.aircraft[0])
        flight = f"{aircraft[1]}_{block.first}"
        files = sorted(self.ledger.of([aircraft]).flight_files().filter(flight_id=flight)["path"])
        return f"{flight} ({', '.join(files)}): {why}"

    def job(self, tables: list[str]) -> dg.JobDefinition:
        """Dagster's job that makes `tables`."""
        keys = frozenset(dg.AssetKey(t) for t in tables)
        return self.defs.resolve_implicit_global_asset_job_def().get_subset(asset_selection=keys)

    def create(self, job: dg.JobDefinition, block: Block, **origins: Any) -> dg.DagsterRun:
        """A run for `block` that is yet to begin; `origins` say where another process finds its code."""
        tags, asked = block.tags() | NIGHT, job.asset_selection
        return self.instance.create_run_for_job(job, tags=tags, asset_selection=asked, run_config=_QUIET, **origins)

    def _run(self, tables: list[str], block: Block) -> str | None:
        """Make `tables` for `block`; None, or why it failed."""
        job = self.job(tables)
        with partitions.standing():
            run = self.create(job, block)
            result = execute_run(InMemoryJob(job), run, self.instance, raise_on_error=False)
        if result.success:
            return None
        self.show_failed(run.run_id, block)
        if any(_was_stopped(e) for e in result.all_events):  # and so is the night, which may be a run itself
            raise DagsterExecutionInterruptedError
        return why_failed(result.all_events) or "the run stopped before a step could say why"

    def show_failed(self, run_id: str, block: Block) -> None:
        """Let the partitions page show as failed what was asked for and not made, and no cell that no flight fills."""
        log, cells = self.instance.event_log_storage, self.known().cells(block)
        if isinstance(log, OneForMany) and cells:
            log.planned_in_vain(run_id, cells)


def _was_stopped(event: dg.DagsterEvent) -> bool:
    """Whether someone ended the run; Dagster calls it a failure of the run, and what follows would go on."""
    failed = event.event_type == dg.DagsterEventType.RUN_FAILURE
    return failed and event.job_failure_data.failure_reason == RunFailureReason.UNEXPECTED_TERMINATION


def why_failed(events: Iterable[dg.DagsterEvent]) -> str | None:
    """The innermost error of the first step that failed, in one line."""
    for event in events:
        error = event.step_failure_data.error if event.is_step_failure else None
        while error is not None and error.cause is not None:
            error = error.cause
        if error is not None:
            return str(error.message).strip().splitlines()[0].removeprefix("dagster._core.definitions.events.Failure: ")
    return None
