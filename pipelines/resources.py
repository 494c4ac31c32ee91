"""Define partitions, the cells of a run and its resources: folders, store and ledger of a home, the IO manager."""

import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property, lru_cache
from pathlib import Path
from typing import NamedTuple

import dagster as dg
import polars as pl
from pydantic import Field

from dagster_batched import report_partitions
from dagster_batched.partitions import RangeKeys, RangePartitions, multi_keys
from hdt_core.tables import TABLES
from pipelines.intake.faults import BREAKS_DECLARATION, NO_FAULTS, Fault, quarantine
from pipelines.intake.landing_file import modified_at
from pipelines.intake.merge import json_text
from pipelines.lineage import MAKER, Stage
from pipelines.storage.delta import StoredShards
from pipelines.storage.ledger import Ledger
from pipelines.storage.objects import StoreError
from pipelines.storage.store import FLEET, Aircraft, Store, shard_of
from pipelines.versions import CELL, expected_versions, restrict_ledger

AIRCRAFT = RangeKeys(name="aircraft")
FLIGHTS = dg.DynamicPartitionsDefinition(name="flight")
AIRCRAFT_FLIGHTS = RangePartitions({"aircraft": AIRCRAFT, "flight": FLIGHTS})
NIGHT = {"hdt/night": "yes"}
"""Tag of a run of the chain, which takes cells with files; a run from Dagster's page may take any."""
PARENT_RUN = "dagster/parent_run_id"
"""Dagster's tag of a run that is another one run again."""


def aircraft_key(operator: str, tail: str) -> str:
    """Format the partition key of an aircraft."""
    return f"{operator}:{tail}"


def flight_key(tail: str, flight_id: str) -> str:
    """Format the partition key of a flight: `YYYYMMDD_LEG`, shared by all aircraft; its id under another tail."""
    return flight_id[-11:] if flight_id == f"{tail}_{flight_id[-11:]}" else flight_id


def cell_keys(cells: Iterable[tuple[str, str]]) -> list[dg.MultiPartitionKey]:
    """Combine keys of aircraft and flights into partition keys."""
    return multi_keys(("aircraft", "flight"), cells)


def aircraft_of(key: str) -> tuple[str, str]:
    """Split an aircraft's key into operator and tail."""
    operator, tail = key.split(":", 1)
    return operator, tail


@lru_cache(maxsize=2)
def cells_of(keys: tuple[str, ...]) -> dict[tuple[str, str, str], str]:
    """Map cells (operator, tail, flight id, empty above flights) to their keys; the same for all tables of a run."""
    return {_cell_of(key): key for key in keys}


def _cell_of(key: str) -> tuple[str, str, str]:
    aircraft, _, flight = key.partition("|")
    operator, tail = aircraft_of(aircraft)
    return operator, tail, flight_of(tail, flight)


def flight_of(tail: str, key: str) -> str:
    """Return the flight id of a partition key of a flight; empty above flights."""
    return f"{tail}_{key}" if len(key) == len("YYYYMMDD_LL") else key


@dataclass(frozen=True)
class PartitionScope:
    """Cells of a run: None for the whole fleet, else aircraft and, by flight, the flights of each."""

    aircraft: dict[tuple[str, str], list[str]] | None

    @classmethod
    def of(cls, keys: list[str] | None) -> "PartitionScope":
        """Build a scope from partition keys, of aircraft or of aircraft and flight."""
        if keys is None:
            return cls(None)
        if "|" not in keys[0]:
            return cls({aircraft_of(key): [] for key in keys})
        aircraft: dict[tuple[str, str], list[str]] = {}
        for operator, tail, flight in cells_of(tuple(keys)):
            aircraft.setdefault((operator, tail), []).append(flight)
        return cls(aircraft)

    def cells(self) -> pl.DataFrame:
        """List the cells: operator, tail, flight_id (empty above flights)."""
        rows = [(o, t, f) for (o, t), flights in (self.aircraft or {FLEET: []}).items() for f in flights or [""]]
        return pl.DataFrame(rows, schema=dict.fromkeys(CELL, pl.String), orient="row")

    def expected_cells(self, ledger: Ledger, table: str) -> pl.DataFrame:
        """List the cells of the run that `table` should have, each with its expected version."""
        if self.aircraft is None:
            return expected_versions(ledger, table).join(self.cells(), on=CELL, how="semi")
        flights = {f for ids in self.aircraft.values() for f in ids}
        own = restrict_ledger(ledger, MAKER[table], self.aircraft, flights)
        return expected_versions(own, table).join(self.cells(), on=CELL, how="semi")

    def versions(self, ledger: Ledger, stage: Stage) -> dict[str, pl.DataFrame]:
        """List the `expected_cells` of each table of a stage; once for all tables of a recipe."""
        table_of = {recipe: table for table, recipe in stage.tables.items()}
        cells = {recipe: self.expected_cells(ledger, table) for recipe, table in table_of.items()}
        return {table: cells[recipe] for table, recipe in stage.tables.items()}

    def read_table(self, store: Store, table: str) -> pl.DataFrame:
        """Read the rows of `table` of the run's aircraft, and of its flights where both are by flight."""
        if self.aircraft is None or TABLES[table].grain == "fleet":
            return store.read_table(table)
        flights = [f for ids in self.aircraft.values() for f in ids]
        if not flights or TABLES[table].grain != "flight":
            return store.read_table(table, self.aircraft)
        rows = store.scan(table, self.aircraft, flights).filter(pl.col("flight_id").is_in(flights)).collect()
        # two operators may fly one registration on one day, and the run have only one of the flights
        return rows.join(self.cells(), on=CELL, how="semi", maintain_order="left")


class Home(dg.ConfigurableResource):  # type: ignore[type-arg]  # yields itself
    """The landing zone and the home of one fleet."""

    landing: str = Field(description="Folder the ground station drops files into (HDT_LANDING).")
    home: str = Field(description="Folder that holds tables, catalog, ledger and Dagster's own storage (HDT_HOME).")

    @cached_property
    def store(self) -> Store:
        """Store of the tables; it caches which files it has checked."""
        return Store(Path(self.home))

    @property
    def ledger(self) -> Ledger:
        """Ledger of delivered files and stored cells."""
        return Ledger(Path(self.home))


class Made(NamedTuple):
    """Rows of a table, and its cells with the versions of what was read to make them."""

    frame: pl.DataFrame
    cells: pl.DataFrame


def is_of_night(tags: Mapping[str, str]) -> bool:
    """Return whether a run with these tags belongs to the chain: one that is run again from the page does not."""
    return NIGHT.items() <= tags.items() and PARENT_RUN not in tags


@contextmanager
def storing(
    ledger: Ledger, scope: PartitionScope, table: str, cells: pl.DataFrame, tags: Mapping[str, str]
) -> Iterator[None]:
    """Store and mark cells in the block, beside other runs.

    A night takes every cell once. Any other run stores alone, and nothing that is older than what a night has stored.

    Raises
    ------
    StoreError
        The inputs of the `cells` have changed since their versions were taken.
    """
    of_night = is_of_night(tags)
    with ledger.turn(shared=of_night):
        if not of_night and not scope.expected_cells(ledger, table).sort(CELL).equals(cells.sort(CELL)):
            raise StoreError(f"{table} is not stored: what it was made of has changed meanwhile; run it again")
        yield


class FrameIO(dg.IOManager):
    """IO manager that writes frames to the store of one home."""

    def __init__(self, store: Store, ledger: Ledger) -> None:
        self.store = store
        self.ledger = ledger

    def handle_output(self, context: dg.OutputContext, made: Made) -> None:
        """Store a frame, mark its cells as stored, and report the rows of each cell."""
        start_s = time.monotonic()
        table = context.asset_key.path[-1]
        tags = context.step_context.run_tags
        scope = PartitionScope.of(list(context.asset_partition_keys) if context.has_asset_partitions else None)
        with storing(self.ledger, scope, table, made.cells, tags):
            self.store_frame(table, scope, made.frame, made.cells)
        if scope.aircraft is None:
            stored_s = round(time.monotonic() - start_s, 3)
            context.add_output_metadata({"rows": made.frame.height, "seconds_to_store": stored_s})
        else:
            report(context, made.frame, made.cells)

    def store_frame(
        self, table: str, scope: PartitionScope, frame: pl.DataFrame, cells: pl.DataFrame | None = None
    ) -> None:
        """Store a frame and mark its cells as stored: by default those that the table should have now."""
        if TABLES[table].grain == "flight":
            self.store.merge(table, scope.aircraft or {}, frame)
        else:
            self.store.replace(table, scope.aircraft or [FLEET], frame)
        self.ledger.mark(table, scope.expected_cells(self.ledger, table) if cells is None else cells)

    def load_input(self, context: dg.InputContext) -> pl.DataFrame:
        """Read a whole table, for a notebook or `dg`; assets read what they need through their stage."""
        return self.store.read_table(context.asset_key.path[-1])


def report(context: dg.OutputContext, frame: pl.DataFrame, expected: pl.DataFrame) -> None:
    """Report cells of a run, each with its own number of rows, in order of departure.

    Most aircraft fly some days only and few flights have a log, and an event for a cell without rows costs as much as
    for one with. So a night reports flights with rows or, where there are none, those that are `expected`. A run from
    Dagster's page reports every cell: an empty one has `rows` 0, and one without files, such as a flight that the
    aircraft never flew, has `expected` 0.
    """
    keys = cells_of(tuple(context.asset_partition_keys))
    by_flight = any(flight for *_, flight in keys)
    flight = pl.col("flight_id") if by_flight else pl.lit("").alias("flight_id")
    rows = {(o, t, f): n for o, t, f, n in frame.group_by("operator", "tail", flight).len().rows()}
    expected_cells = set(expected.select(CELL).rows())
    if by_flight and NIGHT.items() <= context.step_context.run_tags.items():
        cells = [cell for cell in keys if cell in rows] or [cell for cell in keys if cell in expected_cells]
    else:
        cells = list(keys)
    cells.sort(key=lambda cell: (cell[2][-11:], cell))  # a flight id ends in day and leg
    numbers = [{"rows": rows.get(cell, 0)} | ({} if cell in expected_cells else {"expected": 0}) for cell in cells]
    report_partitions(context, [keys[cell] for cell in cells], numbers)


@dg.io_manager(config_schema={"home": dg.StringSource})
def frame_io(context: dg.InitResourceContext) -> FrameIO:
    """Build the IO manager of one home."""
    home = Path(context.resource_config["home"])
    return FrameIO(Store(home), Ledger(home))


_ASIDE = "aside_"
_TABLE_OF_GRAIN = {"flight": "raw_quarantine", "aircraft": "raw_quarantine", "fleet": "raw_files_quarantine"}


def tables_set_aside(store: Store, grain: str) -> set[str]:
    """List the tables of which some rows of some aircraft were set aside in quarantine."""
    names = (shard.rpartition("/")[2] for shard in store.tables.shards(_TABLE_OF_GRAIN[grain]))
    return {name.removeprefix(_ASIDE) for name in names if name.startswith(_ASIDE)}


def store_broken_rows(store: Store, ledger: Ledger, scope: PartitionScope, table: str, rows: pl.DataFrame) -> None:
    """Quarantine rows that violate their table's declaration (from `Table.split_valid`), while the others are stored.

    They are stored beside the rejected delivered rows, in a shard for each table, in place of those of the same cells.
    """
    table_of_rows = _TABLE_OF_GRAIN[TABLES[table].grain]
    name = f"{_ASIDE}{table}"

    def change(shards: StoredShards) -> Iterator[tuple[str, pl.DataFrame]]:
        for aircraft, flights in (scope.aircraft or {FLEET: []}).items():
            shard = name if aircraft == FLEET else shard_of(aircraft, name)
            old_rows = shards.get(shard)
            own_rows = rows if aircraft == FLEET else rows.filter(operator=aircraft[0], tail=aircraft[1])
            if old_rows is not None or own_rows.height:
                new_rows = _quarantine_rows(ledger, aircraft, table, own_rows)
                if old_rows is not None and flights:
                    new_rows = pl.concat([old_rows.filter(~pl.col("flight_id").is_in(flights)), new_rows])
                yield shard, new_rows.sort(TABLES[table_of_rows].key)

    store.tables.change(table_of_rows, change)


def _quarantine_rows(ledger: Ledger, aircraft: Aircraft, table: str, rows: pl.DataFrame) -> pl.DataFrame:
    """Make quarantine rows, each with the first file of its flight."""
    flight_files = ledger.of([aircraft]).flight_files().sort("path").unique("flight_id", keep="first")
    files = {
        f: (path, modified_at(ns)) for f, path, ns in flight_files.select("flight_id", "path", "mtime_ns").iter_rows()
    }
    frames = [NO_FAULTS]
    for row in rows.iter_rows(named=True):
        faults = str(row.pop("faults"))
        flight = row.get("flight_id")
        file, at = files.get(str(flight), (table, datetime.now(UTC)))
        columns = ", ".join(c for c in row if f"{c} " in f"{faults} ")
        fault = Fault(BREAKS_DECLARATION, None, columns or None, f"{table}: {faults}.", 0, flight, json_text(row))
        frames.append(quarantine(file, at, [fault]))
    names = {"operator": pl.lit(aircraft[0]), "tail": pl.lit(aircraft[1])}
    return TABLES["raw_quarantine"].conform(pl.concat(frames).with_columns(**names))
