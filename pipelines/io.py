"""Between Dagster and the store: what an asset returns is written, marked as done, reported for the cells it filled."""

import time
from dataclasses import dataclass

import dagster as dg
import polars as pl
from dagster._core.definitions.partitions.subset import DefaultPartitionsSubset

from hdt_core.tables import TABLES
from pipelines import partitions
from pipelines.ledger import Ledger
from pipelines.series import OneForMany
from pipelines.store import FLEET, Store
from pipelines.versions import CELL, expected


@dataclass(frozen=True)
class Asked:
    """What a run is asked to make: None for the whole fleet, else aircraft and, by flight, the flights of each."""

    aircraft: dict[tuple[str, str], list[str]] | None

    @classmethod
    def of(cls, keys: list[str] | None) -> "Asked":
        """From partition keys, of aircraft or of aircraft and flight."""
        if keys is None:
            return cls(None)
        if "|" not in keys[0]:
            return cls({partitions.aircraft_of(key): [] for key in keys})
        aircraft: dict[tuple[str, str], list[str]] = {}
        for operator, tail, flight in partitions.cells_of(tuple(keys)):
            aircraft.setdefault((operator, tail), []).append(flight)
        return cls(aircraft)

    def cells(self) -> pl.DataFrame:
        """The cells asked for: operator, tail, flight_id (empty above flights)."""
        rows = [(o, t, f) for (o, t), flights in (self.aircraft or {FLEET: []}).items() for f in flights or [""]]
        return pl.DataFrame(rows, schema=dict.fromkeys(CELL, pl.String), orient="row")

    def due(self, ledger: Ledger, table: str) -> pl.DataFrame:
        """The cells that `table` should have, of those asked for, each with the version it should be."""
        own = ledger if self.aircraft is None else ledger.of(self.aircraft)
        return expected(own, table).join(self.cells(), on=CELL, how="semi")

    def read(self, store: Store, table: str) -> pl.DataFrame:
        """What `table` holds for the aircraft, and the flights where both are by flight, that are asked for."""
        if self.aircraft is None or TABLES[table].grain == "fleet":
            return store.read(table)
        frame = store.scan(table, self.aircraft)
        flights = [f for asked in self.aircraft.values() for f in asked]
        if flights and "flight_id" in TABLES[table].schema.columns() and TABLES[table].grain == "flight":
            frame = frame.filter(pl.col("flight_id").is_in(flights))
        return frame.collect()


class FrameIO(dg.IOManager):
    """Writes frames to the store of one home."""

    def __init__(self, store: Store, ledger: Ledger) -> None:
        self.store, self.ledger = store, ledger

    def handle_output(self, context: dg.OutputContext, frame: pl.DataFrame) -> None:
        """Store, then mark as done, then report the cells that were filled and no others."""
        table, began = context.asset_key.path[-1], time.monotonic()
        keys = list(context.asset_partition_keys) if context.has_asset_partitions else None
        asked = Asked.of(keys)
        self._store(table, asked, frame)
        cells = asked.due(self.ledger, table)
        self.ledger.mark(table, cells)
        if TABLES[table].grain == "flight":
            self._report_only(context, frame, cells)
        n = {"rows": frame.height, "cells": cells.height, "seconds_to_store": round(time.monotonic() - began, 3)}
        context.add_output_metadata(n)

    def _store(self, table: str, asked: Asked, frame: pl.DataFrame) -> None:
        grain = TABLES[table].grain
        if grain == "fleet":
            self.store.replace(table, FLEET, frame)
            return
        for (operator, tail), flights in (asked.aircraft or {}).items():
            own = frame.filter(pl.col("operator") == operator, pl.col("tail") == tail)
            if grain == "flight":
                self.store.merge(table, (operator, tail), flights, own)
            else:
                self.store.replace(table, (operator, tail), own.sort(TABLES[table].key))

    @staticmethod
    def _report_only(context: dg.OutputContext, frame: pl.DataFrame, cells: pl.DataFrame) -> None:
        """Narrow a run's range to the cells that hold rows, or that were asked for where none does.

        A range over two dimensions is their product, and most aircraft fly only some of the fleet's flight keys.
        Dagster has no public way to say which cells a step filled; the subset of the output context is where it looks.
        Where the event log can, one cell's event stands for all.
        """
        filled = set((frame if frame.height else cells).select(CELL).unique().rows())
        asked = partitions.cells_of(tuple(context.asset_partition_keys))
        kept = [key for cell, key in asked.items() if cell in filled]
        log = context.step_context.instance.event_log_storage
        if isinstance(log, OneForMany) and kept:
            log.stands_for(context.run_id, context.asset_key, kept)
            kept = kept[:1]
        context._asset_partitions_subset = DefaultPartitionsSubset(set(kept))

    def load_input(self, context: dg.InputContext) -> pl.DataFrame:
        """Whole table, for a notebook or `dg`; assets read what they need through their stage."""
        return self.store.read(context.asset_key.path[-1])
