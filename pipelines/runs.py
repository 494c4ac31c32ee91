"""From what is stale to Dagster runs: a run takes a range of cells, never one flight each."""

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import dagster as dg
import polars as pl
from dagster._core.definitions.job_base import InMemoryJob
from dagster._core.execution.api import execute_run
from dagster._core.storage.tags import ASSET_PARTITION_RANGE_END_TAG, ASSET_PARTITION_RANGE_START_TAG

from pipelines import partitions
from pipelines.eventlog import batch_events
from pipelines.ledger import Ledger

# a line on the console for every event would cost more than storing it; the run's page has them all
_QUIET = {"loggers": {"console": {"config": {"log_level": "CRITICAL"}}}}
CELLS_A_RUN = 2_000  # runs of several aircraft stay below this, so that memory does not grow with the fleet
_NIGHT = {"hdt/night": "yes"}  # a run of the chain, and none that someone started from the page
_OURS = "# Written by hdt."
_INSTANCE = """\
# Written by hdt. Delete this line to make the file yours. Everything lies below this folder; nothing is sent anywhere.
telemetry:
  enabled: false
nux:
  enabled: false
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
    base = home.resolve() / "dagster"
    base.mkdir(parents=True, exist_ok=True)
    settings, ours = base / "dagster.yaml", _INSTANCE.format(base=base)
    if not settings.exists() or settings.read_text().startswith(_OURS):  # a home may have been moved
        settings.write_text(ours)
    return dg.DagsterInstance.from_config(str(base))


@dataclass(frozen=True, slots=True)
class Block:
    """One run's worth of cells: aircraft in partition order and, below them, flights from `first` to `last`."""

    cells: int = 1
    aircraft: tuple[str, ...] = ()
    first: str = ""
    last: str = ""

    def apart(self) -> list["Block"]:
        """The same, one aircraft at a time."""
        return [Block(1, (a,), self.first, self.last) for a in self.aircraft]

    def joined(self, other: "Block", place: dict[str, int]) -> "Block":
        """Both in one range of flights."""
        first = min(self.first, other.first, key=place.__getitem__)
        last = max(self.last, other.last, key=place.__getitem__)
        return Block(self.cells + other.cells, self.aircraft + other.aircraft, first, last)

    def tags(self) -> dict[str, str]:
        """Dagster's range tags and, for whoever looks for an aircraft's runs, its name."""
        if not self.aircraft:
            return {}
        start, end = self.aircraft[0], self.aircraft[-1]
        named = {"hdt/aircraft": start} if start == end else {}
        operators = {a.split(":")[0] for a in self.aircraft}
        named |= {"hdt/operator": operators.pop()} if len(operators) == 1 else {}
        if self.first:
            start, end = f"{start}|{self.first}", f"{end}|{self.last}"
        return {ASSET_PARTITION_RANGE_START_TAG: start, ASSET_PARTITION_RANGE_END_TAG: end, **named}


def _stretches(keys: list[str], wanted: set[str]) -> Iterator[list[str]]:
    """Runs of neighbouring keys that are all wanted."""
    stretch: list[str] = []
    for key in keys:
        if key in wanted:
            stretch.append(key)
        elif stretch:
            yield stretch
            stretch = []
    if stretch:
        yield stretch


@dataclass
class Runner:
    """Runs selections of the location's assets and remembers what failed."""

    defs: dg.Definitions
    instance: dg.DagsterInstance
    runs: int = 0
    cells: int = 0
    failed: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Mark as failed what a killed night left: its runs would stay STARTED for ever.

        Who makes a runner holds the home's lock, so none of them can be alive.
        """
        begun = [dg.DagsterRunStatus.NOT_STARTED, dg.DagsterRunStatus.STARTING, dg.DagsterRunStatus.STARTED]
        for run in self.instance.get_runs(dg.RunsFilter(statuses=begun, tags=_NIGHT)):
            self.instance.report_run_failed(run, "the process was stopped; the next night made what was missing")

    def register(self, cells: pl.DataFrame) -> None:
        """Make a partition of every new aircraft and flight (operator, tail, flight_id), in order of departure."""
        aircraft = {partitions.aircraft_key(o, t) for o, t in cells.select("operator", "tail").unique().rows()}
        flights = {partitions.flight_key(f) for f in cells["flight_id"].unique() if f}
        for definition, keys in ((partitions.AIRCRAFT, aircraft), (partitions.FLIGHTS, flights)):
            new = sorted(keys - set(self._keys(definition)))
            if new:
                self.instance.add_dynamic_partitions(str(definition.name), new)

    def blocks(self, grain: str, wanted: pl.DataFrame, ledger: Ledger) -> Iterator[Block]:
        """Runs that make the wanted cells (operator, tail, flight_id) and no other."""
        if grain == "fleet":
            return iter([Block()])
        if grain == "aircraft":
            return self._aircraft_blocks(wanted, _by_aircraft(ledger.flight_files()))
        return self._flight_blocks(wanted, ledger)

    def _keys(self, definition: dg.DynamicPartitionsDefinition) -> list[str]:
        return list(self.instance.get_dynamic_partitions(str(definition.name)))

    def _aircraft_blocks(self, wanted: pl.DataFrame, flown: dict[str, set[str]]) -> Iterator[Block]:
        """Neighbours that are all wanted, as many as share a run without holding too many flights at once."""
        keys = {partitions.aircraft_key(o, t) for o, t in wanted.select("operator", "tail").rows()}
        for stretch in _stretches(self._keys(partitions.AIRCRAFT), keys):
            held, shared = 0, []
            for aircraft in stretch:
                held += len(flown.get(aircraft, ()))
                if shared and held > CELLS_A_RUN:
                    yield Block(len(shared), tuple(shared))
                    held, shared = len(flown.get(aircraft, ())), []
                shared.append(aircraft)
            yield Block(len(shared), tuple(shared))

    def _flight_blocks(self, wanted: pl.DataFrame, ledger: Ledger) -> Iterator[Block]:
        """Of each aircraft, stretches of its flights that are all wanted; neighbours share a run if none gains one."""
        place = {k: i for i, k in enumerate(self._keys(partitions.FLIGHTS))}
        flown, asked = _by_aircraft(ledger.flight_files()), _by_aircraft(wanted)
        fixed = {a: sorted(place[f] for f in flown[a] - asked.get(a, set()) if f in place) for a in flown}
        shared: Block | None = None
        before = ""
        for aircraft in self._keys(partitions.AIRCRAFT):
            own = sorted((f for f in flown.get(aircraft, ()) if f in place), key=place.__getitem__)
            for stretch in _stretches(own, asked.get(aircraft, set())):
                alone = Block(len(stretch), (aircraft,), stretch[0], stretch[-1])
                joined = shared.joined(alone, place) if shared and shared.aircraft[-1] == before else None
                if (
                    joined
                    and joined.cells <= CELLS_A_RUN
                    and all(_free(fixed[a], joined, place) for a in joined.aircraft)
                ):
                    shared = joined
                    continue
                if shared:
                    yield shared
                shared = alone
            before = aircraft
        if shared:
            yield shared

    def run(self, tables: list[str], block: Block, label: str) -> bool:
        """Make `tables` for `block`; a failure is noted under `label` and does not stop the others."""
        keys = frozenset(dg.AssetKey(t) for t in tables)
        job = self.defs.resolve_implicit_global_asset_job_def().get_subset(asset_selection=keys)
        run = self.instance.create_run_for_job(job, tags=block.tags() | _NIGHT, asset_selection=keys, run_config=_QUIET)
        result = execute_run(InMemoryJob(job), run, self.instance, raise_on_error=False)
        self.runs, self.cells = self.runs + 1, self.cells + block.cells
        if not result.success:
            self.failed[label] = _why(result)
        return bool(result.success)


def _by_aircraft(cells: pl.DataFrame) -> dict[str, set[str]]:
    """Flight keys of each aircraft's key."""
    found: dict[str, set[str]] = {}
    for o, t, f in cells.select("operator", "tail", "flight_id").rows():
        found.setdefault(partitions.aircraft_key(o, t), set()).add(partitions.flight_key(f))
    return found


def _free(fixed: list[int], block: Block, place: dict[str, int]) -> bool:
    """Whether none of an aircraft's flights that must not be made again lies in the block's range."""
    i = bisect_left(fixed, place[block.first])
    return i == len(fixed) or fixed[i] > place[block.last]


def _why(result: object) -> str:
    """The innermost error of a failed run, in one line."""
    for event in result.filter_events(lambda e: e.is_step_failure):  # type: ignore[attr-defined]
        error = event.event_specific_data.error
        while error is not None and error.cause is not None:
            error = error.cause
        if error is not None:
            return str(error.message).strip().splitlines()[0].removeprefix("dagster._core.definitions.events.Failure: ")
    return "the run stopped before a step could say why"
