"""Dagster runs: the instance that records them, one run of a batch of cells, its failures; runs on other machines.

The engine is set in `<home>/dagster/dagster.yaml` (docs/storage.md). Dagster's daemon launches runs on other machines,
finds the lost ones and starts them again; here they are submitted and awaited.
"""

import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import dagster as dg
import polars as pl
import yaml

from dagster_batched.event_log import CoalescingEventLog
from dagster_batched.partitions import cached_ranges
from dagster_batched.runs import (
    InterruptedRunError,
    daemon_answers,
    execute,
    failure_of,
    finished_runs,
    is_active,
    origins,
    report_runless,
    submit,
    successor,
    was_interrupted,
)
from dagster_batched.runs import open_instance as open_instance_in
from hdt_core.loading import UserError
from pipelines.assets import VIEWS
from pipelines.orchestration.batches import BatchResult, PartitionBatch, PartitionIndex, by_aircraft, split_message
from pipelines.resources import AIRCRAFT, FLIGHTS, NIGHT, aircraft_key, aircraft_of, flight_key, flight_of
from pipelines.storage.ledger import Ledger
from pipelines.storage.objects import StoreError
from pipelines.storage.publication import publish
from pipelines.storage.settings import dagster_settings, retention

# a line on the console for every event would cost more than storing it; the run's page has them all
_QUIET = {"loggers": {"console": {"config": {"log_level": "CRITICAL"}}}}
BY = {"user": "hdt nightly"}  # launcher shown in the list of runs
_LAUNCHERS = ("dagster/schedule_name", "dagster/sensor_name", "user")
LOCATION = "pipelines.definitions"
MAX_BISECTED = 3
_CONFIG_MARK = "# Written by hdt."
_CONFIG_NOTE = "Delete this line to make the file yours. Everything lies below this folder; nothing is sent anywhere."
_UNFINISHED = [dg.DagsterRunStatus.NOT_STARTED, dg.DagsterRunStatus.STARTING, dg.DagsterRunStatus.STARTED]


class EngineError(UserError):
    """Runs can't be sent out to other machines; the message gives reason and remedy in one line."""


def open_instance(home: Path) -> dg.DagsterInstance:
    """Open Dagster's own storage below `<home>/dagster`; a `dagster.yaml` of the user's is used as it is.

    Raises
    ------
    StoreError
        Dagster can't use that file, or the home's retention is wrong; one line.
    """
    text = dagster_settings(home)
    days = retention(home).dagster_history_days
    try:
        if not isinstance(yaml.safe_load(text), dict | None):
            raise yaml.YAMLError("it is no mapping")
        return open_instance_in(home.resolve() / "dagster", _CONFIG_MARK, _CONFIG_NOTE, days)
    except (yaml.YAMLError, dg.DagsterInvalidConfigError) as error:
        reason = " ".join(str(error).split())[:300]
        raise StoreError(f"{home / 'dagster/dagster.yaml'} can't be used: {reason}") from None


def launched_by(run: dg.DagsterRun) -> dict[str, str]:
    """Return tags for the runs of a night that is a run itself: its launcher and its id."""
    return {k: v for k, v in run.tags.items() if k in _LAUNCHERS} | {"hdt/night_run": run.run_id}


def publish_night(home: Path, recorded_in: dg.DagsterInstance | None = None) -> None:
    """Publish the catalog and report its views to Dagster as materialized."""
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
        """Mark the runs of a killed night as failed, which would stay STARTED for ever.

        Call it only with the home's lock, when none of them can be alive.
        """
        for run in self.instance.get_runs(dg.RunsFilter(statuses=_UNFINISHED, tags=NIGHT)):
            self.instance.report_run_failed(run, "the process was stopped; the next night made what was missing")

    def register(self, cells: pl.DataFrame) -> None:
        """Add a partition for every new aircraft and flight (operator, tail, flight_id), in order of departure."""
        aircraft = {aircraft_key(o, t) for o, t in cells.select("operator", "tail").unique().rows()}
        flights = {flight_key(t, f) for t, f in cells.select("tail", "flight_id").unique().rows() if f}
        for definition, keys in ((AIRCRAFT, aircraft), (FLIGHTS, flights)):
            new_keys = sorted(keys - set(self._keys(definition)))
            if new_keys:
                self.instance.add_dynamic_partitions(str(definition.name), new_keys)

    def partition_index(self, cells: pl.DataFrame | None = None) -> PartitionIndex:
        """Return the present partitions and the flights of each aircraft, or of the aircraft of `cells` only."""
        aircraft, flights = (self._keys(d) for d in (AIRCRAFT, FLIGHTS))
        ledger = self.ledger if cells is None else self.ledger.of(cells.select("operator", "tail").unique().rows())
        return PartitionIndex(aircraft, flights, by_aircraft(ledger.flights_on_file()))

    def _keys(self, definition: dg.DynamicPartitionsDefinition) -> list[str]:
        return list(self.instance.get_dynamic_partitions(str(definition.name)))

    def make(self, tables: list[str], batch: PartitionBatch, label: str) -> BatchResult:
        """Make a batch in one run; if it fails, in a run for each aircraft, then halves: one flight stops no other."""
        message = self._run(tables, batch, label)
        if message is None:
            return BatchResult(batch.size, 1)
        if len(batch.aircraft) < 2:
            runs, failure = self._bisect_failed_batch(tables, batch, message, label)
            failed = {f"{label}: {batch.label}": failure} if failure else {}
            return BatchResult(batch.size, 1 + runs, failed, () if failure else split_message(label, batch, message))
        results = [self.make(tables, part, label) for part in batch.parts()]
        failed = {place: failure for r in results for place, failure in r.failed.items()}
        repairs = sum((r.repairs for r in results), () if failed else split_message(label, batch, message))
        return BatchResult(batch.size, 1 + sum(r.runs for r in results), failed, repairs)

    def _bisect_failed_batch(self, tables: list[str], batch: PartitionBatch, fault: str, label: str) -> tuple[int, str]:
        """Isolate the flights at which an aircraft's batch fails by bisection; return number of runs and a message.

        After `MAX_BISECTED` failing flights it stops: then flights are not the cause. Each reason is listed once.
        """
        pending = [(batch, fault)]
        runs = 0
        flights_of = dict[str, list[str]]()
        while pending:
            part, failure = pending.pop()
            halves = part.parts() if sum(map(len, flights_of.values())) < MAX_BISECTED else []
            if not halves:
                flights_of.setdefault(failure, []).append(self._describe_flights(part))
            runs += len(halves)
            pending += [(half, failed) for half in reversed(halves) if (failed := self._run(tables, half, label))]
        messages = (": ".join(filter(None, (", ".join(names), failure))) for failure, names in flights_of.items())
        return runs, "; ".join(messages)

    def _describe_flights(self, batch: PartitionBatch) -> str:
        """Name a batch's flight and its files, or its first and last flight; empty without flights."""
        first, last = batch.flights
        if first != last:
            return f"flights {first} to {last}"
        if not first:
            return ""
        aircraft = aircraft_of(batch.label)
        flight = flight_of(aircraft[1], first)
        files = sorted(self.ledger.of([aircraft]).flight_files().filter(flight_id=flight)["path"])
        return f"{flight} ({', '.join(files)})"

    def job(self, tables: list[str]) -> dg.JobDefinition:
        """Return Dagster's job that makes `tables`."""
        keys = frozenset(dg.AssetKey(t) for t in tables)
        return self.defs.resolve_implicit_global_asset_job_def().get_subset(asset_selection=keys)

    def create(self, job: dg.JobDefinition, batch: PartitionBatch, label: str) -> dg.DagsterRun:
        """Create a run for `batch` without starting it, named by the night and its step's `label`.

        It records its code's location, which another process may need and without which Dagster's timeline omits it.
        """
        night = datetime.now(UTC) - timedelta(hours=12)  # named by the day on which it began, noon to noon
        step = {"hdt/step": f"{night:%Y-%m-%d} {label}"}
        tags = batch.tags() | NIGHT | {**self.by, **step}
        selection = job.asset_selection
        origin = origins(job, LOCATION)
        return self.instance.create_run_for_job(job, tags=tags, asset_selection=selection, run_config=_QUIET, **origin)

    def _run(self, tables: list[str], batch: PartitionBatch, label: str) -> str | None:
        """Make `tables` for `batch`; return the failure's message, or None."""
        job = self.job(tables)
        with cached_ranges({batch.ends(): batch.partition_keys()} if batch.cells else None):
            run = self.create(job, batch, label)
            result = execute(job, run, self.instance)
        if result.success:
            return None
        self.show_failed(run.run_id, batch)
        if was_interrupted(result.all_events):  # and so is the night, which may be a run itself
            raise InterruptedRunError
        return failure_of(result.all_events) or "the run stopped before a step could report an error"

    def show_failed(self, run_id: str, batch: PartitionBatch) -> None:
        """Mark the batch's cells as failed on the partitions page, and no others of its range."""
        log = self.instance.event_log_storage
        if isinstance(log, CoalescingEventLog) and batch.cells:
            log.mark_failed_partitions(run_id, batch.partition_keys())


LOOK_S = 0.5
AHEAD = 500  # runs queued at once: Dagster scans its whole queue each time


class RemoteExecutor:
    """Execute batches on other machines, by the same methods as `LocalExecutor`."""

    ranges = True  # several machines want several runs, and a run's tags name a range

    def __init__(self, runner: Runner) -> None:
        self.runner = runner
        self.instance = runner.instance

    def settle(self) -> None:
        """Wait for runs that a killed night had sent out, so that none is made twice; cancel those not started."""
        if not daemon_answers(self.instance):
            raise EngineError(f"no Dagster daemon answers; start one: `dagster-daemon run --module-name {LOCATION}`")
        for run in self.instance.get_runs(dg.RunsFilter(statuses=[dg.DagsterRunStatus.NOT_STARTED], tags=NIGHT)):
            self.instance.report_run_canceled(run, "its night was stopped before it was sent out")
        while is_active(self.instance, NIGHT):
            time.sleep(LOOK_S)

    def process_count(self, flights: int) -> int:
        """Return 1: the number of workers is set elsewhere, and runs are small."""
        return 1

    def prepare(self, flights: int) -> None:
        """Do nothing: the workers run already."""

    def should_distribute(self, batches: list[PartitionBatch], flights: int) -> bool:
        """Send out whatever there is, for the night's own machine may be a small one."""
        return bool(batches)

    def make(self, tables: list[str], batches: list[PartitionBatch], label: str) -> Iterator[BatchResult]:
        """Make the batches in any order and yield each result when it is ready.

        A run that Dagster retries is tracked under its new id; one of several aircraft that failed for good is replaced
        by a run of each.
        """
        job = self.runner.job(tables)
        unsent = deque(batches)
        running = dict[str, PartitionBatch]()
        whole_batches = set(batches)
        while unsent or running:
            while unsent and len(running) < AHEAD:
                batch = unsent.popleft()
                run = self.runner.create(job, batch, label)
                submit(self.instance, run)
                running[run.run_id] = batch
            for run in finished_runs(self.instance, running):
                batch = running.pop(run.run_id)
                if retry_id := successor(run):
                    running[retry_id] = batch
                    continue
                failure = None if run.is_success else self._failure_message(run, batch)
                repairs: tuple[str, ...] = ()
                if failure and len(batch.aircraft) > 1:
                    unsent.extend(batch.parts())
                    repairs = split_message(label, batch, failure)
                    failure = None
                cells = batch.size if batch in whole_batches else 0  # cells of parts were counted with the whole batch
                yield BatchResult(cells, 1, {f"{label}: {batch.label}": failure} if failure else {}, repairs)
            time.sleep(LOOK_S)

    def close(self) -> None:
        """Do nothing: the workers outlive the night."""

    def _failure_message(self, run: dg.DagsterRun, batch: PartitionBatch) -> str:
        self.runner.show_failed(run.run_id, batch)
        kinds = {dg.DagsterEventType.STEP_FAILURE, dg.DagsterEventType.RUN_FAILURE, dg.DagsterEventType.RUN_CANCELED}
        events = [entry.get_dagster_event() for entry in self.instance.all_logs(run.run_id, of_type=kinds)]
        return failure_of(events) or next((e.message for e in reversed(events) if e.message), run.status.value)
