"""Dagster runs: where they are recorded, one run of a batch of cells, what failed."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import dagster as dg
import polars as pl

from dagster_batched import instance
from dagster_batched.coalescing import CoalescingEventLog
from dagster_batched.materialization import report_runless
from dagster_batched.partitions import cached_ranges
from dagster_batched.runs import InterruptedRunError, execute, failure_of, origins, was_interrupted
from pipelines import partitions
from pipelines.assets.published import VIEWS
from pipelines.orchestration.batches import BatchResult, PartitionBatch, PartitionIndex, by_aircraft, made_apart
from pipelines.partitions import NIGHT
from pipelines.storage.ledger import Ledger
from pipelines.storage.publication import publish

# a line on the console for every event would cost more than storing it; the run's page has them all
_QUIET = {"loggers": {"console": {"config": {"log_level": "CRITICAL"}}}}
BY = {"user": "hdt nightly"}  # what the list of runs names as who launched it
_LAUNCHERS = ("dagster/schedule_name", "dagster/sensor_name", "user")
LOCATION = "pipelines.definitions"
MOST_PINNED = 3
_OURS = "# Written by hdt."
_SAYS = "Delete this line to make the file yours. Everything lies below this folder; nothing is sent anywhere."
_BEGUN = [dg.DagsterRunStatus.NOT_STARTED, dg.DagsterRunStatus.STARTING, dg.DagsterRunStatus.STARTED]


def open_instance(home: Path) -> dg.DagsterInstance:
    """Dagster's own storage below `<home>/dagster`; a `dagster.yaml` the user put there is used as it is."""
    return instance.open_instance(home.resolve() / "dagster", _OURS, _SAYS)


def launched_by(run: dg.DagsterRun) -> dict[str, str]:
    """Tags of the runs of a night that is a run itself: who launched that launched these, and which it is."""
    return {k: v for k, v in run.tags.items() if k in _LAUNCHERS} | {"hdt/night_run": run.run_id}


def publish_night(home: Path, recorded_in: dg.DagsterInstance | None = None) -> None:
    """Publish the catalog and tell Dagster, on whose pages each view stands behind what it reads."""
    publish(home)
    report_runless(recorded_in or open_instance(home), [dg.AssetMaterialization(view.key) for view in VIEWS])


@dataclass(frozen=True, slots=True)
class Runner:
    """Runs selections of the location's assets."""

    defs: dg.Definitions
    instance: dg.DagsterInstance
    ledger: Ledger
    by: Mapping[str, str]

    def fail_orphaned_runs(self) -> None:
        """Mark as failed what a killed night left: its runs would stay STARTED for ever.

        Only for who has just taken the home's lock: none of them can be alive.
        """
        for run in self.instance.get_runs(dg.RunsFilter(statuses=_BEGUN, tags=NIGHT)):
            self.instance.report_run_failed(run, "the process was stopped; the next night made what was missing")

    def register(self, cells: pl.DataFrame) -> None:
        """Make a partition of every new aircraft and flight (operator, tail, flight_id), in order of departure."""
        aircraft = {partitions.aircraft_key(o, t) for o, t in cells.select("operator", "tail").unique().rows()}
        flights = {partitions.flight_key(f) for f in cells["flight_id"].unique() if f}
        for definition, keys in ((partitions.AIRCRAFT, aircraft), (partitions.FLIGHTS, flights)):
            new = sorted(keys - set(self._keys(definition)))
            if new:
                self.instance.add_dynamic_partitions(str(definition.name), new)

    def known(self, wanted: pl.DataFrame | None = None) -> PartitionIndex:
        """Partitions as they are now, and who flew which, of all or of those who fly the `wanted` cells."""
        aircraft, flights = (self._keys(d) for d in (partitions.AIRCRAFT, partitions.FLIGHTS))
        own = self.ledger if wanted is None else self.ledger.of(wanted.select("operator", "tail").unique().rows())
        return PartitionIndex(aircraft, flights, by_aircraft(own.flights_on_file()))

    def _keys(self, definition: dg.DynamicPartitionsDefinition) -> list[str]:
        return list(self.instance.get_dynamic_partitions(str(definition.name)))

    def make(self, tables: list[str], batch: PartitionBatch, label: str) -> BatchResult:
        """One run. If it fails, each of its aircraft alone, and of one aircraft halves: one flight stops no other."""
        why = self._run(tables, batch, label)
        if why is None:
            return BatchResult(batch.size, 1)
        if len(batch.aircraft) < 2:
            runs, told = self._pinned_down(tables, batch, why, label)
            failed, mended = ({f"{label}: {batch.label}": told}, ()) if told else ({}, made_apart(label, batch, why))
            return BatchResult(batch.size, 1 + runs, failed, mended)
        alone = [self.make(tables, one, label) for one in batch.parts()]
        failed = {where: why for one in alone for where, why in one.failed.items()}
        mended = sum((one.mended for one in alone), () if failed else made_apart(label, batch, why))
        return BatchResult(batch.size, 1 + sum(one.runs for one in alone), failed, mended)

    def _pinned_down(self, tables: list[str], batch: PartitionBatch, why: str, label: str) -> tuple[int, str]:
        """Make what can be made of an aircraft's batch that failed, half by half; how many runs, and what fails why.

        After `MOST_PINNED` flights the rest is left as it is: then it is not the flights. Each reason is told once.
        """
        left, runs, where = [(batch, why)], 0, dict[str, list[str]]()
        while left:
            one, said = left.pop()
            halves = one.parts() if sum(map(len, where.values())) < MOST_PINNED else []
            if not halves:
                where.setdefault(said, []).append(self._named(one))
            runs += len(halves)
            left += [(half, failed) for half in reversed(halves) if (failed := self._run(tables, half, label))]
        return runs, "; ".join(": ".join(filter(None, (", ".join(places), said))) for said, places in where.items())

    def _named(self, batch: PartitionBatch) -> str:
        """The flight of a batch and its files, or the first and last of its flights; nothing where it has none."""
        first, last = batch.flights
        if first != last:
            return f"flights {first} to {last}"
        if not first:
            return ""
        aircraft = partitions.aircraft_of(batch.label)
        flight = f"{aircraft[1]}_{first}"
        files = sorted(self.ledger.of([aircraft]).flight_files().filter(flight_id=flight)["path"])
        return f"{flight} ({', '.join(files)})"

    def job(self, tables: list[str]) -> dg.JobDefinition:
        """Dagster's job that makes `tables`."""
        keys = frozenset(dg.AssetKey(t) for t in tables)
        return self.defs.resolve_implicit_global_asset_job_def().get_subset(asset_selection=keys)

    def create(self, job: dg.JobDefinition, batch: PartitionBatch, label: str) -> dg.DagsterRun:
        """A run for `batch` that is yet to begin. `label` is what its step is called.

        It says where its code is found: another process may need it, and Dagster's timeline shows no run without.
        """
        tags, asked = batch.tags() | NIGHT | {**self.by, "hdt/step": label}, job.asset_selection
        where = origins(job, LOCATION)
        return self.instance.create_run_for_job(job, tags=tags, asset_selection=asked, run_config=_QUIET, **where)

    def _run(self, tables: list[str], batch: PartitionBatch, label: str) -> str | None:
        """Make `tables` for `batch`; None, or why it failed."""
        job = self.job(tables)
        with cached_ranges({batch.ends(): batch.partition_keys()} if batch.cells else None):
            run = self.create(job, batch, label)
            result = execute(job, run, self.instance)
        if result.success:
            return None
        self.show_failed(run.run_id, batch)
        if was_interrupted(result.all_events):  # and so is the night, which may be a run itself
            raise InterruptedRunError
        return failure_of(result.all_events) or "the run stopped before a step could say why"

    def show_failed(self, run_id: str, batch: PartitionBatch) -> None:
        """Let the partitions page show as failed what was asked for and not made, and no cell that no flight fills."""
        log = self.instance.event_log_storage
        if isinstance(log, CoalescingEventLog) and batch.cells:
            log.mark_failed_partitions(run_id, batch.partition_keys())
