"""Between Dagster and the store: what an asset returns is written, marked as done, reported cell by cell."""

import time

import dagster as dg
import polars as pl

from dagster_batched import report_partitions
from hdt_core.tables import TABLES
from pipelines import partitions
from pipelines.lineage import LINEAGE, Recipe
from pipelines.partitions import NIGHT, PartitionScope
from pipelines.storage.ledger import Ledger
from pipelines.storage.store import FLEET, Store
from pipelines.versions import CELL


class FrameIO(dg.IOManager):
    """Writes frames to the store of one home."""

    def __init__(self, store: Store, ledger: Ledger) -> None:
        self.store, self.ledger = store, ledger
        self._due: dict[Recipe, tuple[PartitionScope, pl.DataFrame]] = {}

    def handle_output(self, context: dg.OutputContext, frame: pl.DataFrame) -> None:
        """Store, then mark as done, then tell what each cell of the run holds."""
        began = time.monotonic()
        scope = PartitionScope.of(list(context.asset_partition_keys) if context.has_asset_partitions else None)
        cells = self.keep(context.asset_key.path[-1], scope, frame)
        if scope.aircraft is None:
            stored_s = round(time.monotonic() - began, 3)
            context.add_output_metadata({"rows": frame.height, "seconds_to_store": stored_s})
        else:
            report(context, frame, cells)

    def keep(self, table: str, scope: PartitionScope, frame: pl.DataFrame) -> pl.DataFrame:
        """Store a frame and mark as done the cells that were due, which are returned."""
        if TABLES[table].grain == "flight":
            self.store.merge(table, scope.aircraft or {}, frame)
        else:
            self.store.replace(table, scope.aircraft or [FLEET], frame)
        cells = self._due_cells(table, scope)
        self.ledger.mark(table, cells)
        return cells

    def _due_cells(self, table: str, scope: PartitionScope) -> pl.DataFrame:
        """Asked once for all tables of a recipe, which are stored one after the other when their parents are made."""
        recipe = LINEAGE[table]
        if not (recipe.parents or recipe.files):  # made of nothing but its name
            return scope.due(self.ledger, table)
        asked, cells = self._due.get(recipe, (None, None))
        if cells is None or asked != scope:
            cells = scope.due(self.ledger, table)
            self._due[recipe] = scope, cells
        return cells

    def load_input(self, context: dg.InputContext) -> pl.DataFrame:
        """Whole table, for a notebook or `dg`; assets read what they need through their stage."""
        return self.store.read(context.asset_key.path[-1])


def report(context: dg.OutputContext, frame: pl.DataFrame, due: pl.DataFrame) -> None:
    """Report cells of a run, each with its own number of rows, in order of departure.

    Most aircraft fly some days only and few flights leave a log, and an event for each cell without rows would cost as
    much as for one with. So a night reports flights that hold rows or, where none does, those that are `due`. Whoever
    asks from Dagster's page is told of every cell: one that is empty has `rows` 0, and one that no file asks for, such
    as a flight that the aircraft never flew, has `expected` 0.
    """
    asked = partitions.cells_of(tuple(context.asset_partition_keys))
    by_flight = any(flight for *_, flight in asked)
    flight = pl.col("flight_id") if by_flight else pl.lit("").alias("flight_id")
    rows = {(o, t, f): n for o, t, f, n in frame.group_by("operator", "tail", flight).len().rows()}
    wanted = set(due.select(CELL).rows())
    if by_flight and NIGHT.items() <= context.step_context.run_tags.items():
        told = [cell for cell in asked if cell in rows] or [cell for cell in asked if cell in wanted]
    else:
        told = list(asked)
    told.sort(key=lambda cell: (cell[2][-11:], cell))  # day and leg end a flight
    numbers = [{"rows": rows.get(cell, 0)} | ({} if cell in wanted else {"expected": 0}) for cell in told]
    report_partitions(context, [asked[cell] for cell in told], numbers)
