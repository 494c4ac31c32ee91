"""One night, or all of history: from what lies in the landing zone to a published catalog."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import polars as pl

from pipelines.intake.refusals import ignored_entries
from pipelines.intake.scan import scan
from pipelines.lineage import STAGES, Stage
from pipelines.orchestration.around_night import call_hooks, tell_receivers
from pipelines.orchestration.local_executor import EngineError, LocalExecutor, sends_out, work, workers
from pipelines.orchestration.order import Step, steps
from pipelines.repair import repair_home
from pipelines.storage import history, ledger_copy
from pipelines.storage.delta import DamageError
from pipelines.storage.ledger import Ledger
from pipelines.storage.publication import find_catalog_fault, publish
from pipelines.storage.settings import HOME_SETTINGS, notify_file, retention
from pipelines.storage.store import Store
from pipelines.versions import CELL, recipe_version, restrict_ledger, stale

if TYPE_CHECKING:
    from dagster import OpExecutionContext

    from pipelines.orchestration.batches import BatchResult, PartitionBatch
    from pipelines.orchestration.remote_executor import RemoteExecutor
    from pipelines.orchestration.runs import Runner


class Progress(Protocol):
    """Where a long run says how far it is."""

    def start(self, label: str, total: int) -> None:
        """A step of `total` cells begins."""

    def advance(self, cells: int) -> None:
        """So many cells more are made."""


@dataclass(frozen=True, slots=True)
class Night:
    """What a night did."""

    files: int
    new_files: int
    runs: int
    cells: int
    failed: dict[str, str]
    mended: tuple[str, ...] = ()
    not_read: tuple[str, ...] = ()
    """A line for each name in the landing zone that fits nothing."""
    new_paths: frozenset[str] = frozenset()
    """Paths of the new files."""
    after: dict[str, str | None] = field(default_factory=dict)
    """What the hooks of `hdt.after_night` gave."""
    not_followed: tuple[str, ...] = ()
    """A line for each hook that failed."""
    untold: tuple[str, ...] = ()
    """A line for each receiver of the digest that could not be told."""

    @property
    def idle(self) -> bool:
        """Whether there was nothing to do."""
        return self.runs == 0 and not self.failed

    def then(self, again: Night) -> Night:
        """A night that met damage and the same begun again."""
        return replace(
            again,
            new_files=self.new_files + again.new_files,
            runs=self.runs + again.runs,
            cells=self.cells + again.cells,
            mended=(*self.mended, *again.mended),
            new_paths=self.new_paths | again.new_paths,
        )


def complete_night(
    landing: Path,
    home: Path,
    progress: Progress,
    only: pl.Expr | None = None,
    within: OpExecutionContext | None = None,
    jobs: int = 1,
    *,
    before: Night | None = None,
) -> tuple[Night, str | None]:
    """Run a night, publish the catalog and do what follows; why it was made anew though there was nothing to do.

    A night that meets a damaged file is begun again, once: all files are read then, and what is damaged is made again.
    `before` is what the night did until it met one; the other arguments are those of `run_night`.
    """
    done = before or Night(0, 0, 0, 0, {})
    try:
        done = done.then(run_night(landing, home, progress, only, within, jobs))
        if before or not (done.failed and Store(home).place.suspect):
            fault = _publish(home, done, within)
            given, failed = call_hooks(home)
            return replace(done, after=given, not_followed=failed, untold=tell_receivers(home)), fault
    except DamageError:
        if before:
            raise
    return complete_night(landing, home, progress, only, within, jobs, before=done)


def _publish(home: Path, night: Night, within: OpExecutionContext | None) -> str | None:
    """Publish what a night made; of one that had nothing to do, why the catalog was made anew."""
    if within or not night.idle:
        from pipelines.orchestration.runs import publish_night  # Dagster is loaded already

        publish_night(home, within.instance if within else None)
        return None
    fault = "tables were damaged" if night.mended else find_catalog_fault(home)
    if fault:
        publish(home)
    return fault


def run_night(
    landing: Path,
    home: Path,
    progress: Progress,
    only: pl.Expr | None = None,
    within: OpExecutionContext | None = None,
    jobs: int = 1,
) -> Night:
    """Take in what is new and bring everything that depends on it up to date.

    Parameters
    ----------
    landing, home : Path
        Folders.
    progress : Progress
        Told what is being done.
    only : Expr, optional
        Which cells (operator, tail, flight_id; empty above flights) are wanted in this run; all by default.
    within : OpExecutionContext, optional
        Of the run that the night is: its runs are recorded where that one is, and as launched by who launched it.
    jobs : int
        Processes that may work side by side, where there is enough to do; 1 `within` a run.
    """
    ledger, store, began = Ledger(home), Store(home), _now()
    check_settings(home)
    with workers(landing, home, 1 if within else jobs) as hands:
        chain = _Chain(landing, home, ledger, progress, only, within, hands)
        if sends_out(home):
            chain.send_out()  # first: what a killed night sent out may still be writing
        store.sweep()
        chain.mended += repair_home(landing, store, ledger)
        found = scan(landing, ledger)
        chain.expect(found.flights)
        chain.settled_version = ledger.settled_version()
        for step in () if ledger.is_settled(recipe_version(ledger, STAGES)) else steps(STAGES):
            chain.step(step)
    if only is None and not chain.failed:
        ledger.settle(recipe_version(ledger, STAGES))
    unread = tuple(ignored_entries(found.not_read))
    night = Night(
        found.files, found.new, chain.runs, chain.cells, chain.failed, tuple(chain.mended), unread, found.new_paths
    )
    ledger.note_night((began, _now(), night.files, night.new_files, night.runs, night.cells, json.dumps(night.failed)))
    if night.idle:  # else once the catalog is published
        ledger_copy.copy_ledger(ledger, idle=True)
    return night


def check_settings(home: Path) -> None:
    """Read what the home declares before anything is done by it: a wrong file is said now, and not after the night."""
    retention(home)
    for read in HOME_SETTINGS.values():
        read(home)
    if notify_file(home).exists():
        from pipelines.digest import receivers_of

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
    within: OpExecutionContext | None
    hands: LocalExecutor | RemoteExecutor
    runs: int = 0
    cells: int = 0
    flights: int = 0
    failed: dict[str, str] = field(default_factory=dict)
    mended: list[str] = field(default_factory=list)
    settled_version: str | None = None

    def send_out(self) -> None:
        """Let other machines make the batches, once what a killed night had sent them is done."""
        from pipelines.orchestration.remote_executor import RemoteExecutor

        if self.within:
            raise EngineError("a night that is itself a run would wait for a worker that waits behind it; use cron")
        self.hands = RemoteExecutor(self.runner)
        self.hands.settle()

    def expect(self, new: int) -> None:
        """Prepare for so many new flights, of aircraft that have flown before."""
        past = self.ledger.of(self.moved[0]).flights_on_file().height if new else 0
        self.hands.expect(work(new, past))

    def step(self, step: Step) -> None:
        """Bring its stages up to date; one that is not stale runs only if a stage before it does."""
        # a new model of the fleet makes every cell stale
        few = self.settled_version == recipe_version(self.ledger, STAGES)
        cells = [self._wanted(stage, few) for stage in step.stages]
        first = next((i for i, c in enumerate(cells) if c.height), None)
        if first is None:
            return
        wanted, tables = pl.concat(cells).unique(), [t for stage in step.stages[first:] for t in stage.tables]
        if step.grain != "fleet":
            self.runner.register(wanted)
        if step.grain == "flight":
            self.flights = max(self.flights, wanted.height)
        self.progress.start(step.label, wanted.height)
        apart = self.hands.ranges
        index = self.runner.known(None if apart else wanted)
        flights = work(self.flights, index.count(step.grain, wanted))
        folded, among = 1 if apart else step.folded, self.hands.among(flights)
        batches = list(index.batches(step.grain, wanted, folded, among, ranges=apart))
        for made in self._make(tables, batches, step.label, flights):
            self.runs, self.cells = self.runs + made.runs, self.cells + made.cells
            self.failed |= made.failed
            self.mended += made.mended
            self.progress.advance(made.cells)

    @cached_property
    def moved(self) -> tuple[list[tuple[str, str]], list[str]]:
        """Aircraft and flights whose files came since nothing was stale."""
        moved = self.ledger.changed_cells()
        return moved.select("operator", "tail").unique().rows(), moved["flight_id"].unique().to_list()

    def _wanted(self, stage: Stage, few: bool) -> pl.DataFrame:
        """Stale cells; where only a `few` can be, of those whose files have moved."""
        few = few and stage.grain != "fleet"
        cells = stale(restrict_ledger(self.ledger, stage, *self.moved) if few else self.ledger, stage).select(CELL)
        return cells if self.only is None or stage.grain == "fleet" else cells.filter(self.only)

    def _make(
        self, tables: list[str], batches: list[PartitionBatch], label: str, flights: int
    ) -> Iterator[BatchResult]:
        """Share the batches out, if so many new flights are worth it."""
        if self.hands.worth(batches, flights):
            return self.hands.make(tables, batches, label)
        self.hands.stop()
        return (self.runner.make(tables, batch, label) for batch in batches)

    @cached_property
    def runner(self) -> Runner:
        """Who runs what is not shared out."""
        from pipelines.assets.location import asset_definitions
        from pipelines.orchestration.runs import BY, Runner, launched_by, open_instance

        if self.within is None and (anew := history.replace_damaged_history(self.home, whole=False)):
            self.mended.append(anew)
        defs = asset_definitions(self.landing.resolve(), self.home.resolve())
        instance = self.within.instance if self.within else open_instance(self.home)
        runner = Runner(defs, instance, self.ledger, launched_by(self.within.run) if self.within else BY)
        if not sends_out(self.home):
            runner.fail_orphaned_runs()
        return runner
