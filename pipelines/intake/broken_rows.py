"""Quarantine computed rows that violate their table's declaration, while the others are stored.

They are stored beside the rejected delivered rows, in a shard for each table, which is rewritten with their cells.
"""

from collections.abc import Iterator
from datetime import UTC, datetime

import polars as pl

from hdt_core.tables import TABLES
from pipelines.intake.faults import NO_FAULTS, Fault, quarantine
from pipelines.intake.landing_file import modified_at
from pipelines.intake.merge import json_text
from pipelines.partitions import PartitionScope
from pipelines.storage.delta import StoredShards
from pipelines.storage.ledger import Ledger
from pipelines.storage.store import FLEET, Aircraft, Store, shard_of

BREAKS_DECLARATION = "breaks_declaration"
_TABLE_OF_GRAIN = {"flight": "raw_quarantine", "aircraft": "raw_quarantine", "fleet": "raw_files_quarantine"}


def store_broken_rows(store: Store, ledger: Ledger, scope: PartitionScope, table: str, rows: pl.DataFrame) -> None:
    """Store invalid rows of `table` (from `Table.split_valid`) in place of those stored of the same cells before."""
    table_of_rows, name = _TABLE_OF_GRAIN[TABLES[table].grain], f"aside_{table}"

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
        faults, flight = str(row.pop("faults")), row.get("flight_id")
        file, at = files.get(str(flight), (table, datetime.now(UTC)))
        columns = ", ".join(c for c in row if f"{c} " in f"{faults} ")
        fault = Fault(BREAKS_DECLARATION, None, columns or None, f"{table}: {faults}.", 0, flight, json_text(row))
        frames.append(quarantine(file, at, [fault]))
    names = {"operator": pl.lit(aircraft[0]), "tail": pl.lit(aircraft[1])}
    return TABLES["raw_quarantine"].conform(pl.concat(frames).with_columns(**names))
