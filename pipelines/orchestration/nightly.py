"""One night, or all of history: from files in the landing zone to a published catalog."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import polars as pl

from pipelines.intake.faults import ignored_entries
from pipelines.intake.scan import find_loss, scan
from pipelines.lineage import STAGES, Stage, Step, steps
from pipelines.orchestration.around_night import call_hooks, notify_receivers
from pipelines.orchestration.local_executor import LocalExecutor, equivalent_flights, sends_out
from pipelines.repair import repair_home, replace_damaged_history
from pipelines.storage.catalog_checks import find_catalog_fault
from pipelines.storage.delta import DamageError
from pipelines.storage.ledger import Ledger
from pipelines.storage.ledger_copy import copy_ledger
from pipelines.storage.publication import publish
from pipelines.storage.settings import HOME_SETTINGS, dagster_settings, notify_file, retention
from pipelines.storage.store import Store
from pipelines.versions import CELL, find_stale_cells, recipe_version, restrict_ledger

if TYPE_CHECKING:
    from dagster import DagsterInstance, OpExecutionContext

    from pipelines.orchestration.batches import BatchResult, PartitionBatch
    from pipelines.orchestration.runs import RemoteExecutor, Runner


class Progress(Protocol):
    """Progress display of a long run."""

    def start(self, label: str, total: int) -> None:
        """Begin a step of `total` cells."""

    def advance(self, cells: int) -> None:
        """Count so many more cells as made."""


@dataclass(frozen=True, slots=True)
class Night:
    """Outcome of a night."""

    files: int
    new_files: int
    runs: int
    cells: int
    failed: dict[str, str]
    repairs: tuple[str, ...] = ()
    ignored_names: tuple[str, ...] = ()
    """A line for each name in the landing zone that fits no pattern."""
    new_paths: frozenset[str] = frozenset()
    """Paths of the new files."""
    hook_results: dict[str, str | None] = field(default_factory=dict)
    """Results of the hooks of `hdt.after_night`."""
    failed_hooks: tuple[str, ...] = ()
    """A line for each hook that failed."""
    failed_deliveries: tuple[str, ...] = ()
    """A line for each receiver whose digest could not be sent."""
    instance: DagsterInstance | None = None
    """The instance that recorded its runs, if there were any."""

    @property
    def idle(self) -> bool:
        """True where nothing was stale."""
        return self.runs == 0 and not self.failed

    def combine(self, second: Night) -> Night:
        """Add up this first attempt, which met damage, and the second."""
        return replace(
            second,
            new_files=self.new_files + second.new_files,
            runs=self.runs + second.runs,
            cells=self.cells + second.cells,
            repairs=(*self.repairs, *second.repairs),
            new_paths=self.new_paths | second.new_paths,
        )


def complete_night(
    landing: Path,
    home: Path,
    progress: Progress,
    only: pl.Expr | None = None,
    parent_run: OpExecutionContext | None = None,
    jobs: int = 1,
    *,
    first_attempt: Night | None = None,
) -> tuple[Night, str | None]:
    """Run a night, publish the catalog, call hooks; also return why an idle night published, if it did.

    A night that meets a damaged file is repeated once: it reads all files and makes damaged tables again.
    `first_attempt` is its outcome until then; the other arguments are those of `run_night`.
    """
    night = first_attempt or Night(0, 0, 0, 0, {})
    try:
        night = night.combine(run_night(landing, home, progress, only, parent_run, jobs))
        if first_attempt or not (night.failed and Store(home).place.suspect):
            fault = _publish(home, night, parent_run)
            results, failed = call_hooks(home)
            night = replace(night, hook_results=results, failed_hooks=failed)
            night = replace(night, failed_deliveries=notify_receivers(home))
            return replace(night, failed_hooks=(*failed, *_shorten_history(home, night, parent_run))), fault
    except DamageError:
        if first_attempt:
            raise
    return complete_night(landing, home, progress, only, parent_run, jobs, first_attempt=night)


def _publish(home: Path, night: Night, parent_run: OpExecutionContext | None) -> str | None:
    """Publish a night's tables; of an idle night, return why the catalog was written again, if it was."""
    if parent_run or not night.idle:
        from pipelines.orchestration.runs import publish_night  # Dagster is loaded already

        publish_night(home, parent_run.instance if parent_run else night.instance)
        return None
    fault = "tables were damaged" if night.repairs else find_catalog_fault(home)
    if fault:
        publish(home)
    return fault


def _shorten_history(home: Path, night: Night, parent_run: OpExecutionContext | None) -> tuple[str, ...]:
    """Forget old runs, unless the night was idle: it has not loaded Dagster."""
    instance = parent_run.instance if parent_run else night.instance
    if instance is None:
        return ()
    from pipelines.orchestration.history import forget_old_runs

    return forget_old_runs(home, instance, night.cells)


def run_night(
    landing: Path,
    home: Path,
    progress: Progress,
    only: pl.Expr | None = None,
    parent_run: OpExecutionContext | None = None,
    jobs: int = 1,
) -> Night:
    """Ingest new files and update every table that depends on them.

    Parameters
    ----------
    landing, home : Path
        Folders.
    progress : Progress
        Display that is updated.
    only : Expr, optional
        Filter on operator, tail and flight_id (empty above flights) of the cells to make; all by default.
    parent_run : OpExecutionContext, optional
        Dagster run that the night belongs to: its runs go to the same instance, with the same launcher.
    jobs : int
        Processes that may run in parallel where there is enough to do; 1 with a `parent_run`.
    """
    ledger = Ledger(home)
    store = Store(home)
    start = _now()
    check_settings(home)
    with closing(LocalExecutor(landing, home, 1 if parent_run else jobs)) as executor:
        chain = _Chain(landing, home, ledger, progress, only, parent_run, executor)
        if sends_out(home):
            chain.send_out()  # first: runs that a killed night sent out may still be writing
        store.sweep()
        chain.repairs += repair_home(landing, store, ledger)
        zone = scan(landing, ledger)
        chain.prepare(zone.flights)
        chain.settled_version = ledger.settled_version()
        for step in () if ledger.is_settled(recipe_version(ledger, STAGES)) else steps(STAGES):
            chain.step(step)
    may_lack_files = chain.runs or not zone.files
    if loss := find_loss(landing, zone, ledger.file_records() if may_lack_files else {}):
        chain.failed["landing zone"] = loss
    if only is None and not chain.failed:
        ledger.settle(recipe_version(ledger, STAGES))
    ignored = tuple(ignored_entries(zone.quarantine))
    night = Night(
        zone.files, zone.new, chain.runs, chain.cells, chain.failed, tuple(chain.repairs), ignored, zone.new_paths,
        instance=chain.runner.instance if chain.runs else None,
    )  # fmt: skip
    ledger.note_night((start, _now(), night.files, night.new_files, night.runs, night.cells, json.dumps(night.failed)))
    if night.idle:  # else once the catalog is published
        copy_ledger(ledger, idle=True)
    return night


def check_settings(home: Path) -> None:
    """Validate the home's settings before the night, so that an invalid file fails at once."""
    retention(home)
    dagster_settings(home)
    for read_setting in HOME_SETTINGS.values():
        read_setting(home)
    if os.path.lexists(notify_file(home)):
        from pipelines.digest.declaration import receivers_of

        receivers_of(home)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


@dataclass
class _Chain:
    """The steps of one night; Dagster is loaded only when there is something to run."""

    landing: Path
    home: Path
    ledger: Ledger
    progress: Progress
    only: pl.Expr | None
    parent_run: OpExecutionContext | None
    executor: LocalExecutor | RemoteExecutor
    runs: int = 0
    cells: int = 0
    flights: int = 0
    failed: dict[str, str] = field(default_factory=dict)
    repairs: list[str] = field(default_factory=list)
    settled_version: str | None = None

    def send_out(self) -> None:
        """Switch to other machines, once the runs that a killed night had sent them have ended."""
        from pipelines.orchestration.runs import EngineError, RemoteExecutor

        if self.parent_run:
            raise EngineError("a night that is itself a run would wait for a worker that waits behind it; use cron")
        self.executor = RemoteExecutor(self.runner)
        self.executor.settle()

    def prepare(self, n_new: int) -> None:
        """Prepare the executor for so many new flights and the past of their aircraft."""
        n_past = self.ledger.of(self.changed_cells[0]).flights_on_file().height if n_new else 0
        self.executor.prepare(equivalent_flights(n_new, n_past))

    def step(self, step: Step) -> None:
        """Update a step's stale stages and those that follow from them."""
        # a new model of the fleet makes every cell stale
        only_changed = bool(self.settled_version) and self.settled_version == recipe_version(self.ledger, STAGES)
        cells = {stage.name: self._stale_cells(stage, only_changed) for stage in step.stages}
        tables = step.tables([name for name, stale in cells.items() if stale.height])
        if not tables:
            return
        stale_cells = pl.concat(cells.values()).unique()
        if step.grain != "fleet":
            self.runner.register(stale_cells)
        if step.grain == "flight":
            self.flights = max(self.flights, stale_cells.height)
        self.progress.start(step.label, stale_cells.height)
        as_ranges = self.executor.ranges
        index = self.runner.partition_index(None if as_ranges else stale_cells)
        flights = equivalent_flights(self.flights, index.count(step.grain, stale_cells))
        batch_factor = 1 if as_ranges else step.batch_factor
        n_processes = self.executor.process_count(flights)
        batches = list(index.batches(step.grain, stale_cells, batch_factor, n_processes, ranges=as_ranges))
        for result in self._make(tables, batches, step.label, flights):
            self.runs = self.runs + result.runs
            self.cells = self.cells + result.cells
            self.failed |= result.failed
            self.repairs += result.repairs
            self.progress.advance(result.cells)

    @cached_property
    def changed_cells(self) -> tuple[list[tuple[str, str]], list[str]]:
        """Aircraft and flights whose files changed since the last night that left nothing stale."""
        cells = self.ledger.changed_cells()
        return cells.select("operator", "tail").unique().rows(), cells["flight_id"].unique().to_list()

    def _stale_cells(self, stage: Stage, only_changed: bool) -> pl.DataFrame:
        """Return stale cells; with `only_changed` look only at those whose files have changed."""
        only_changed = only_changed and stage.grain != "fleet"
        ledger = restrict_ledger(self.ledger, stage, *self.changed_cells) if only_changed else self.ledger
        cells = find_stale_cells(ledger, stage).select(CELL)
        return cells if self.only is None or stage.grain == "fleet" else cells.filter(self.only)

    def _make(
        self, tables: list[str], batches: list[PartitionBatch], label: str, flights: int
    ) -> Iterator[BatchResult]:
        """Distribute the batches if so many flights are worth it, else make them in this process."""
        if self.executor.should_distribute(batches, flights):
            return self.executor.make(tables, batches, label)
        self.executor.close()
        return (self.runner.make(tables, batch, label) for batch in batches)

    @cached_property
    def runner(self) -> Runner:
        """Runner in this process."""
        from pipelines.assets import asset_definitions
        from pipelines.orchestration.runs import BY, Runner, launched_by, open_instance

        if self.parent_run is None and (anew := replace_damaged_history(self.home, whole=False)):
            self.repairs.append(anew)
        defs = asset_definitions(self.landing.resolve(), self.home.resolve())
        instance = self.parent_run.instance if self.parent_run else open_instance(self.home)
        runner = Runner(defs, instance, self.ledger, launched_by(self.parent_run.run) if self.parent_run else BY)
        if not sends_out(self.home):
            runner.fail_orphaned_runs()
        return runner
