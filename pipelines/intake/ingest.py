"""Files become the stored flights of an aircraft, with an account of every delivered row.

A flight is made of all files that hold it, whenever they came, so the order of arrival leaves no trace. Rows whose file
has since left the landing zone, or now holds no good row of the flight, are taken from the store: a file that is sent
again and arrives broken takes nothing away.
"""

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

import polars as pl

from hdt_core.tables import TABLES
from pipelines.intake.columns import AIRPORTS
from pipelines.intake.landing_file import LandingFile, received
from pipelines.intake.merge import MergeResult, merge_deliveries
from pipelines.intake.redelivered import ACCOUNT, redelivered
from pipelines.intake.set_aside import BROKEN
from pipelines.intake.snapshots import ROW_COLUMNS, Intake, read_snapshots
from pipelines.lineage import FLIGHT_FILES
from pipelines.storage.ledger import Ledger
from pipelines.storage.store import Store

LEAST_ROWS = 0.1
"""Share of the rows of a file's fullest pack from which on another is a pack and no slip of the recorder."""


@dataclass(frozen=True)
class IngestResult:
    """What came of an aircraft's files for some of its flights."""

    rows: pl.DataFrame
    deliveries: pl.DataFrame
    quarantine: pl.DataFrame


def ingest_flights(
    landing: Path, store: Store, ledger: Ledger, aircraft: tuple[str, str], flights: list[str]
) -> IngestResult:
    """Read every file that holds one of `flights` and merge what it says with what is stored of files that are gone."""
    held = ledger.of([aircraft]).flight_files().filter(pl.col("kind").is_in(FLIGHT_FILES))
    first = held.group_by("path").agg(pl.col("flight_id").min().alias("carrier")).rename({"path": "file"})
    files = landing_files(landing, held.filter(pl.col("flight_id").is_in(flights)))
    stored = StoredRows(store, aircraft, flights, [f.path for f in files])
    packs = stored.packs()
    intake = read_snapshots([replace(f, packs_stored=packs.get(f.path, 0)) for f in files], datetime.now(UTC))
    _must_balance(intake)
    rows, quarantine = _wanted(intake.rows, flights), _wanted(_carried(intake.quarantine, first), flights)
    spoke = rows.select(ACCOUNT).unique()
    received_at = {path: received(ns) for path, ns in held.select("path", "mtime_ns").iter_rows()}
    before = redelivered(rows, quarantine, *stored.replaced(), received_at)
    rows, quarantine = pl.concat([rows, before.rows]), pl.concat([quarantine, before.quarantine])
    merged = merge_deliveries([rows, stored.rows(spoke)], received_at)
    here = MergeResult(*(part.join(spoke, on=ACCOUNT, how="semi") for part in merged))
    account = _account(rows, quarantine, here)
    quarantine = pl.concat([quarantine, merged.quarantine])
    whole = {"operator": pl.lit(aircraft[0]), "tail": pl.lit(aircraft[1])}
    return IngestResult(
        merged.rows.drop("row_in_file"),
        pl.concat([account, stored.deliveries(merged, spoke)]).group_by(ACCOUNT).sum().with_columns(**whole),
        pl.concat([quarantine, stored.quarantine()], how="diagonal").with_columns(**whole),
    )


@dataclass(frozen=True)
class StoredRows:
    """What is stored of some flights from files that are not in the landing zone, or do not speak of them any more.

    `present` are files that lie there; `spoke` (file, flight_id) says which of them hold good rows of which flight.
    """

    store: Store
    aircraft: tuple[str, str]
    flights: list[str]
    present: list[str]

    def _of(self, table: str) -> pl.DataFrame:
        some = self.store.scan(table, [self.aircraft], self.flights)
        held = some.filter(pl.col("flight_id").is_in(self.flights)).collect()
        return TABLES[table].conform(held)

    def _quarantined(self) -> pl.DataFrame:
        """Of what was delivered: computed rows are set aside anew by their own stage."""
        return self._of("raw_quarantine").filter(pl.col("reason") != BROKEN)

    @cached_property
    def _recorded(self) -> pl.DataFrame:
        both = pl.concat([self._of("raw_snapshots"), self._of("raw_logs")])
        return both.with_columns(row_in_file=pl.lit(0, pl.Int64)).select(ROW_COLUMNS)

    def packs(self) -> dict[str, int]:
        """Highest number of a pack of which each file has stored more than a few odd rows."""
        sizes = self._recorded.filter(pl.col("file").is_in(self.present)).group_by("file", "pack").len()
        real = sizes.filter(pl.col("len") >= LEAST_ROWS * pl.col("len").max().over("file"))
        return dict(real.group_by("file").agg(pl.col("pack").max()).iter_rows())

    def rows(self, spoke: pl.DataFrame) -> pl.DataFrame:
        """Rows as `read_snapshots` gave them."""
        return self._recorded.join(spoke, on=ACCOUNT, how="anti")

    def replaced(self) -> tuple[pl.DataFrame, pl.DataFrame]:
        """Rows and quarantine rows that earlier versions of files that lie there have left."""
        here = pl.col("file").is_in(self.present)
        return self._recorded.filter(here), self._quarantined().filter(here)

    def quarantine(self) -> pl.DataFrame:
        """Quarantine rows as they were."""
        return self._quarantined().filter(~pl.col("file").is_in(self.present))

    def deliveries(self, merged: MergeResult, spoke: pl.DataFrame) -> pl.DataFrame:
        """Their account, with what has been said better since counted as duplicate."""
        loaded = _count(merged.rows).rename({"n": "now"})
        aside = _n_rows(merged.quarantine)
        absent = ~pl.col("file").is_in(self.present)
        told = self._of("raw_deliveries").filter(absent).select(*ACCOUNT, "delivered", "quarantined")
        # of broken files, or stored by a killed night
        untold = _count(self.rows(spoke)).join(told, on=ACCOUNT, how="anti")
        kept = untold.select(*ACCOUNT, delivered="n", quarantined=pl.lit(0, pl.Int64))
        before = (
            pl.concat([told, kept])
            .join(loaded, on=ACCOUNT, how="left", validate="m:1")
            .join(aside, on=ACCOUNT, how="left", validate="m:1")
        )
        before = before.with_columns(
            loaded=pl.col("now").fill_null(0), quarantined=pl.col("quarantined") + pl.col("n").fill_null(0)
        )
        said = pl.col("delivered") - pl.col("loaded") - pl.col("quarantined")
        return before.with_columns(duplicate=said).select(*ACCOUNT, "delivered", "loaded", "quarantined", "duplicate")


def landing_files(landing: Path, listed: pl.DataFrame) -> list[LandingFile]:
    """The files of ledger rows that still lie in the landing zone, by path."""
    columns = ("path", "operator", "tail", "kind", "size", "mtime_ns", "digest")
    rows = listed.select(columns).unique().sort("path").rows()
    root, there = str(landing.resolve()), (row for row in rows if (landing / row[0]).is_file())
    return [LandingFile(root, *row, judged_by=digest.partition(" ")[2]) for *row, digest in there]  # type: ignore[misc]


def flights_of(rows: pl.DataFrame) -> pl.DataFrame:
    """One row a flight: when it was, and what was recorded of it."""
    acms, cpl = pl.col("source") == "acms", pl.col("source") == "cpl"
    source = (
        pl.when(acms.any() & cpl.any())
        .then(pl.lit("both"))
        .when(cpl.any())
        .then(pl.lit("cpl"))
        .otherwise(pl.lit("acms"))
    )
    times = pl.col("time_utc")
    return rows.group_by("operator", "tail", "flight_id").agg(
        times.min().alias("departed_at"),
        times.max().alias("landed_at"),
        source.alias("source"),
        times.filter(acms).n_unique().cast(pl.Int64).alias("n_snapshots"),
        times.filter(cpl).n_unique().cast(pl.Int64).alias("n_seconds"),
        *(pl.col(c).sort_by("time_utc").drop_nulls().first() for c in AIRPORTS),
    )


def _must_balance(intake: Intake) -> None:
    """Each file's rows were counted when it was opened; what was made of them must come to the same."""
    out = pl.concat(
        [
            intake.rows.group_by("file").agg(pl.len().cast(pl.Int64).alias("n")),
            intake.quarantine.group_by("file").agg(pl.col("n_rows").sum().alias("n")),
        ]
    )
    sums = intake.delivered.join(out.group_by("file").agg(pl.col("n").sum()), on="file", how="left", validate="m:1")
    wrong = sums.filter(pl.col("n_delivered") != pl.col("n").fill_null(0))
    if wrong.height:
        raise ValueError(
            f"rows of {wrong['file'][0]} do not add up:"
            f" {wrong['n_delivered'][0]} delivered, {wrong['n'][0]} accounted for"
        )


def _carried(quarantine: pl.DataFrame, carriers: pl.DataFrame) -> pl.DataFrame:
    """Rows that name no flight of their file go with its first flight, so that each is told once."""
    joined = quarantine.join(carriers, on="file", how="left", validate="m:1")
    return joined.with_columns(pl.coalesce("flight_id", "carrier").alias("flight_id")).drop("carrier")


def _wanted(frame: pl.DataFrame, flights: list[str]) -> pl.DataFrame:
    return frame.filter(pl.col("flight_id").is_in(flights))


def _account(rows: pl.DataFrame, quarantine: pl.DataFrame, merged: MergeResult) -> pl.DataFrame:
    """Rows delivered, loaded, quarantined and duplicate, for each file and flight; they must balance."""
    came, kept_aside = _count(rows), _n_rows(quarantine)
    parts = {
        "delivered": pl.concat([came, kept_aside]),
        "loaded": _count(merged.rows),
        "quarantined": pl.concat([kept_aside, _n_rows(merged.quarantine)]),
        "duplicate": merged.duplicates.rename({"n_duplicate": "n"}),
    }
    account = parts["delivered"].select(ACCOUNT).unique()
    for name, part in parts.items():
        summed = part.group_by(ACCOUNT).agg(pl.col("n").sum().alias(name))
        account = account.join(summed, on=ACCOUNT, how="left", validate="m:1")
    return account.with_columns(pl.col(*parts).fill_null(0).cast(pl.Int64)).select(*ACCOUNT, *parts)


def _n_rows(quarantine: pl.DataFrame) -> pl.DataFrame:
    return quarantine.group_by(ACCOUNT).agg(pl.col("n_rows").sum().alias("n"))


def _count(rows: pl.DataFrame) -> pl.DataFrame:
    return rows.group_by(ACCOUNT).agg(pl.len().cast(pl.Int64).alias("n"))
