"""Dagster runs: where they are recorded, one run of a block of cells, what failed."""

from dataclasses import dataclass
from pathlib import Path

import dagster as dg
import polars as pl

from dagster_batched.event_log import CoalescingEventLog
from dagster_batched.partitions import cached_ranges, skip_input_versions
from dagster_batched.remote import origins
from dagster_batched.runs import InterruptedRunError, execute, failure_of, was_interrupted
from dagster_batched.sqlite import batch_events
from pipelines import partitions
from pipelines.orchestration.batches import BatchResult, PartitionBatch, PartitionIndex, by_aircraft, made_apart
from pipelines.storage.ledger import Ledger

# a line on the console for every event would cost more than storing it; the run's page has them all
_QUIET = {"loggers": {"console": {"config": {"log_level": "CRITICAL"}}}}
NIGHT = {"hdt/night": "yes"}  # a run of the chain, and none that someone started from the page
BY = {"user": "hdt nightly"}  # what the list of runs names as who launched it
LOCATION = "pipelines.definitions"
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
  module: dagster_batched.sqlite
  class: BatchedSqliteEventLogStorage
  config:
    base_dir: {base}/history
"""


def open_instance(home: Path) -> dg.DagsterInstance:
    """Dagster's own storage below `<home>/dagster`; a `dagster.yaml` the user put there is used as it is."""
    batch_events()
    skip_input_versions()
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

    def fail_orphaned_runs(self) -> None:
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

    def known(self) -> PartitionIndex:
        """Partitions as they are now, and who flew which."""
        aircraft, flights = (self._keys(d) for d in (partitions.AIRCRAFT, partitions.FLIGHTS))
        return PartitionIndex(aircraft, flights, by_aircraft(self.ledger.flight_files()))

    def _keys(self, definition: dg.DynamicPartitionsDefinition) -> list[str]:
        return list(self.instance.get_dynamic_partitions(str(definition.name)))

    def make(self, tables: list[str], block: PartitionBatch, label: str) -> BatchResult:
        """One run. If it fails, each of its aircraft alone, and of one aircraft halves: one flight stops no other."""
        why = self._run(tables, block, label)
        if why is None:
            return BatchResult(block, 1, {})
        if len(block.aircraft) < 2 and not block.parts:
            runs, told = self._pinned_down(tables, block, why, label)
            return BatchResult(block, 1 + runs, {f"{label}: {block.aircraft[0] if block.aircraft else 'fleet'}": told})
        alone = [self.make(tables, one, label) for one in block.apart()]
        failed = {where: why for one in alone for where, why in one.failed.items()}
        mended = sum((one.mended for one in alone), () if failed else made_apart(label, block, why))
        return BatchResult(block, 1 + sum(one.runs for one in alone), failed, mended)

    def _pinned_down(self, tables: list[str], block: PartitionBatch, why: str, label: str) -> tuple[int, str]:
        """Make what can be made of an aircraft's block that failed, half by half; how many runs, and what fails why.

        After `MOST_PINNED` flights the rest is left as it is: then it is not the flights.
        """
        left, runs, told = [(block, why)], 0, list[str]()
        while left:
            one, said = left.pop()
            halves = self.known().halves(one) if len(told) < MOST_PINNED else []
            if not halves:
                told.append(self._named(one, said))
            runs += len(halves)
            left += [(half, failed) for half in reversed(halves) if (failed := self._run(tables, half, label))]
        return runs, "; ".join(told)

    def _named(self, block: PartitionBatch, why: str) -> str:
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

    def create(self, job: dg.JobDefinition, block: PartitionBatch, label: str) -> dg.DagsterRun:
        """A run for `block` that is yet to begin. `label` is what its step is called.

        It says where its code is found: another process may need it, and Dagster's timeline shows no run without.
        """
        tags, asked = block.tags() | NIGHT | BY | {"hdt/step": label}, job.asset_selection
        where = origins(job, LOCATION)
        return self.instance.create_run_for_job(job, tags=tags, asset_selection=asked, run_config=_QUIET, **where)

    def _run(self, tables: list[str], block: PartitionBatch, label: str) -> str | None:
        """Make `tables` for `block`; None, or why it failed."""
        job = self.job(tables)
        with cached_ranges({block.ends(): self.known().cells(block)} if block.parts else None):
            run = self.create(job, block, label)
            result = execute(job, run, self.instance)
        if result.success:
            return None
        self.show_failed(run.run_id, block)
        if was_interrupted(result.all_events):  # and so is the night, which may be a run itself
            raise InterruptedRunError
        return failure_of(result.all_events) or "the run stopped before a step could say why"

    def show_failed(self, run_id: str, block: PartitionBatch) -> None:
        """Let the partitions page show as failed what was asked for and not made, and no cell that no flight fills."""
        log, cells = self.instance.event_log_storage, self.known().cells(block)
        if isinstance(log, CoalescingEventLog) and cells:
            log.mark_failed_partitions(run_id, cells)
