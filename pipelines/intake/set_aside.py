"""Computed rows that break their table's declaration: kept in quarantine with the reason, while the others are stored.

They lie beside the delivered rows that were refused, in a shard of their own for each table, which is written anew
whenever their cells are.
"""

from collections.abc import Iterator
from datetime import UTC, datetime

import polars as pl

from hdt_core.tables import TABLES
from pipelines.intake.landing_file import received
from pipelines.intake.ledger import QUARANTINE_SCHEMA, Fault, quarantine
from pipelines.intake.merge import as_text
from pipelines.partitions import PartitionScope
from pipelines.storage.delta import Held
from pipelines.storage.ledger import Ledger
from pipelines.storage.store import FLEET, Aircraft, Store, shard_of

BROKEN = "breaks_declaration"
_KEPT_IN = {"flight": "raw_quarantine", "aircraft": "raw_quarantine", "fleet": "raw_files_quarantine"}


def set_aside(store: Store, ledger: Ledger, scope: PartitionScope, table: str, broken: pl.DataFrame) -> None:
    """Keep `broken` rows of `table` (as `Table.broken` gives them) in place of those kept of the same cells before."""
    kept_in, asked = _KEPT_IN[TABLES[table].grain], scope.aircraft or {FLEET: []}

    def change(held: Held) -> Iterator[tuple[str, pl.DataFrame]]:
        for aircraft, flights in asked.items():
            shard = shard_of(aircraft, name) if aircraft != FLEET else name
            before = held.get(shard)
            own = broken if aircraft == FLEET else broken.filter(operator=aircraft[0], tail=aircraft[1])
            if before is not None or own.height:
                told = _told(ledger, aircraft, table, own)
                kept = (
                    told.clear()
                    if before is None
                    else before.filter(~pl.col("flight_id").is_in(flights), bool(flights))
                )
                yield shard, pl.concat([kept, told]).sort(TABLES[kept_in].key)

    name = f"aside_{table}"
    store.tables.change(kept_in, change)


def _told(ledger: Ledger, aircraft: Aircraft, table: str, broken: pl.DataFrame) -> pl.DataFrame:
    """Quarantine rows, each with the first file of its flight."""
    held = ledger.of([aircraft]).flight_files().sort("path").unique("flight_id", keep="first")
    files = {f: (path, received(ns)) for f, path, ns in held.select("flight_id", "path", "mtime_ns").iter_rows()}
    rows = []
    for row in broken.iter_rows(named=True):
        faults, flight = str(row.pop("faults")), row.get("flight_id")
        file, at = files.get(str(flight), (table, datetime.now(UTC)))
        columns = ", ".join(c for c in row if f"{c} " in f"{faults} ")
        fault = Fault(BROKEN, None, columns or None, f"{table}: {faults}.", 0, flight, as_text(row))
        rows.append(quarantine(file, at, [fault]))
    whole = {"operator": pl.lit(aircraft[0]), "tail": pl.lit(aircraft[1])}
    return TABLES["raw_quarantine"].conform(
        pl.concat([pl.DataFrame(schema=QUARANTINE_SCHEMA), *rows]).with_columns(**whole)
    )
