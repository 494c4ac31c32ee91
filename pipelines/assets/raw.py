"""What was recorded, typed, in SI, each row once; and an account of every row that was delivered."""

from datetime import UTC, datetime
from pathlib import Path

import polars as pl

from hdt_core.records.unit_index import date_entries
from hdt_core.tables.raw import RawFleet
from pipelines.assets.stage import stage
from pipelines.intake.components import Delivered
from pipelines.intake.coverage import coverage
from pipelines.intake.ingest import flights_of, ingest_flights, landing_files
from pipelines.intake.landing import LandingFile, list_landing
from pipelines.intake.logs import Log, read_fleet, read_maintenance, read_messages
from pipelines.intake.scan import REJECTED
from pipelines.intake.snapshots import read_snapshots
from pipelines.intake.types_of_zone import types_of
from pipelines.partitions import PartitionScope
from pipelines.resources import Home
from pipelines.storage.store import Store


@stage
def raw_fleet(home: Home) -> tuple[pl.DataFrame, ...]:
    """The fleet list, and files that hold no flight at all."""
    landing, ledger, now = Path(home.landing), home.ledger, datetime.now(UTC)
    lists = [(f, read_fleet(f, now)) for f in landing_files(landing, ledger.files(["fleet"]))]
    rejected = read_snapshots(landing_files(landing, ledger.files([REJECTED])), now)
    left = rejected.delivered.select("file", delivered="n_delivered", loaded=0, quarantined="n_delivered", duplicate=0)
    refused = [list_landing(landing).quarantine, rejected.quarantine]
    return (
        pl.concat([RawFleet.create_empty(), *(x.rows for _, x in lists)], how="diagonal_relaxed"),
        pl.concat([left, *(account(f, x) for f, x in lists)], how="vertical_relaxed"),
        pl.concat([*refused, *(x.quarantine for _, x in lists)]),
        coverage(types_of(landing.resolve())),
    )


@stage
def raw_records(scope: PartitionScope, home: Home) -> tuple[pl.DataFrame, ...]:
    """Maintenance messages the aircraft raised and work that was done on them."""
    landing, now, aircraft = Path(home.landing), datetime.now(UTC), list(scope.aircraft or {})
    listed = home.ledger.files(list(RECORDS)).filter(pl.struct("operator", "tail").is_in(_keys(aircraft)))
    here = landing_files(landing, listed)
    fleet = home.store.read("raw_fleet")
    read = [(f, RECORDS[f.kind][1](f, now, fleet)) for f in here]
    tables = [_records(kind, [(f, x) for f, x in read if f.kind == kind], scope, home.store) for kind in RECORDS]
    deliveries = [of_aircraft(f, account(f, x)) for f, x in read]
    quarantine = [of_aircraft(f, x.quarantine) for f, x in read]
    paths = [f.path for f in here]
    return (
        *tables,
        pl.concat([left("raw_records_deliveries", paths, scope, home.store), *deliveries], how="diagonal").with_columns(
            _COUNTED
        ),
        pl.concat([left("raw_records_quarantine", paths, scope, home.store), *quarantine], how="diagonal"),
    )


RECORDS = {"messages": ("raw_messages", read_messages), "maintenance": ("raw_maintenance", read_maintenance)}
_COUNTED = pl.col("delivered", "loaded", "quarantined", "duplicate").fill_null(0)


def _keys(aircraft: list[tuple[str, str]]) -> list[dict[str, str]]:
    return [{"operator": o, "tail": t} for o, t in aircraft]


def _records(kind: str, read: list[tuple[LandingFile, Log]], scope: PartitionScope, store: Store) -> pl.DataFrame:
    """Rows of the files that lie there; of aircraft whose file has left the landing zone, what is stored."""
    table, here = RECORDS[kind][0], [(f.operator, f.tail) for f, _ in read]
    stored = scope.read(store, table).filter(~pl.struct("operator", "tail").is_in(_keys(here)))
    rows = pl.concat([stored, *(x.rows for _, x in read)], how="diagonal")
    return date_entries(rows) if kind == "maintenance" else rows


def left(table: str, present: list[str], scope: PartitionScope, store: Store) -> pl.DataFrame:
    """What is stored of files that have left the landing zone."""
    return scope.read(store, table).filter(~pl.col("file").is_in(present))


def of_aircraft(file: LandingFile, frame: pl.DataFrame) -> pl.DataFrame:
    """`frame` with the operator and tail whose folder holds the file."""
    return frame.with_columns(operator=pl.lit(file.operator), tail=pl.lit(file.tail))


def account(file: LandingFile, read: Log | Delivered) -> pl.DataFrame:
    """Where the rows of one file went."""
    quarantined = int(read.quarantine["n_rows"].sum())
    counts = {
        "delivered": read.n_delivered,
        "loaded": read.n_loaded,
        "quarantined": quarantined,
        "duplicate": read.n_duplicate,
    }
    return pl.DataFrame({"file": [file.path]} | {k: [v] for k, v in counts.items()})


@stage
def raw(scope: PartitionScope, home: Home) -> tuple[pl.DataFrame, ...]:
    """Snapshot reports and continuous logs of each flight, from every file that holds it, whenever it came."""
    landing = Path(home.landing)
    aircraft = (scope.aircraft or {}).items()
    taken = [ingest_flights(landing, home.store, home.ledger, a, flights) for a, flights in aircraft]
    rows = pl.concat([t.rows for t in taken])
    return (
        rows.filter(pl.col("source") == "acms"),
        rows.filter(pl.col("source") == "cpl"),
        pl.concat([t.deliveries for t in taken]),
        pl.concat([t.quarantine for t in taken], how="diagonal_relaxed"),
        flights_of(rows),
    )
