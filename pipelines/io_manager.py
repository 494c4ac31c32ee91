"""Between Dagster and the store: what an asset returns is written, marked as done, reported for the cells it filled."""

import time

import dagster as dg
import polars as pl

from dagster_batched import report_partitions
from hdt_core.tables import TABLES
from pipelines import partitions
from pipelines.partitions import PartitionScope
from pipelines.storage.ledger import Ledger
from pipelines.storage.store import FLEET, Store
from pipelines.versions import CELL


def _by_departure(cell: tuple[str, str, str]) -> str:
    """Day and leg, which end a flight's id."""
    return cell[2][-11:]


class FrameIO(dg.IOManager):
    """Writes frames to the store of one home."""

    def __init__(self, store: Store, ledger: Ledger) -> None:
        self.store, self.ledger = store, ledger

    def handle_output(self, context: dg.OutputContext, frame: pl.DataFrame) -> None:
        """Store, then mark as done, then report the cells that were filled and no others."""
        table, began = context.asset_key.path[-1], time.monotonic()
        keys = list(context.asset_partition_keys) if context.has_asset_partitions else None
        scope = PartitionScope.of(keys)
        self._store(table, scope, frame)
        cells = scope.due(self.ledger, table)
        self.ledger.mark(table, cells)
        shown = self._report(context, frame, cells) if TABLES[table].grain == "flight" else {"rows": frame.height}
        n = shown | {
            "rows_of_run": frame.height,
            "cells": cells.height,
            "seconds_to_store": round(time.monotonic() - began, 3),
        }
        context.add_output_metadata(n)

    def _store(self, table: str, scope: PartitionScope, frame: pl.DataFrame) -> None:
        if TABLES[table].grain == "flight":
            self.store.merge(table, scope.aircraft or {}, frame)
        else:
            self.store.replace(table, scope.aircraft or [FLEET], frame.sort(TABLES[table].key))

    @staticmethod
    def _report(context: dg.OutputContext, frame: pl.DataFrame, cells: pl.DataFrame) -> dict[str, int]:
        """Report the cells that hold rows, or that were asked for where none does: most aircraft fly some days only.

        The last flight comes first, as Dagster's pages list events; returned is what its event tells.
        """
        counted = frame.group_by(CELL).len() if frame.height else cells.select(*CELL, pl.lit(0)).unique()
        rows = {(o, t, f): n for o, t, f, n in counted.rows()}
        asked = partitions.cells_of(tuple(context.asset_partition_keys))
        last_first = sorted((cell for cell in asked if cell in rows), key=_by_departure, reverse=True)
        numbers = [{"rows": rows[cell]} for cell in last_first]
        report_partitions(context, [asked[cell] for cell in last_first], numbers)
        return numbers[0] if numbers else {}

    def load_input(self, context: dg.InputContext) -> pl.DataFrame:
        """Whole table, for a notebook or `dg`; assets read what they need through their stage."""
        return self.store.read(context.asset_key.path[-1])
