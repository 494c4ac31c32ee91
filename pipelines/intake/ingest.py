"""Build the stored flights of an aircraft from its files, with an account of every delivered row.

A flight is built from all files that hold it, whenever they came, so the order of arrival doesn't matter. Rows whose
file has left the landing zone, or now holds no good row of the flight, come from the store: a file that is delivered
again and is broken removes nothing.
"""

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import polars as pl

from hdt_core.tables import TABLES
from pipelines.intake.faults import BREAKS_DECLARATION
from pipelines.intake.landing_file import UNREAD, LandingFile, Registered, modified_at
from pipelines.intake.merge import ACCOUNT, MergeResult, compare_redelivery, count_rows, merge_deliveries
from pipelines.intake.snapshots import ROW_COLUMNS, Intake, read_snapshots
from pipelines.lineage import FLIGHT_FILES
from pipelines.storage.ledger import Ledger
from pipelines.storage.store import Store

MIN_ROW_SHARE = 0.1
"""Least rows of a pack, as a share of the file's fullest pack, that are no error of the recorder."""


@dataclass(frozen=True)
class IngestResult:
    """Rows, account and quarantine of an aircraft's files for some of its flights."""

    rows: pl.DataFrame
    deliveries: pl.DataFrame
    quarantine: pl.DataFrame
    inputs_changed: bool
    """Whether a file was not read as it was registered."""


def ingest_flights(
    landing: Path, store: Store, ledger: Ledger, aircraft: tuple[str, str], flights: list[str]
) -> IngestResult:
    """Read every file that holds one of `flights` and merge its rows with those stored of removed files."""
    own_files = ledger.of([aircraft]).flight_files()
    flight_files = own_files.filter(pl.col("kind").is_in(FLIGHT_FILES))
    carriers = flight_files.group_by("path").agg(pl.col("flight_id").min().alias("carrier")).rename({"path": "file"})
    files = landing_files(landing, flight_files.filter(pl.col("flight_id").is_in(flights)))
    stored_rows = StoredRows(store, aircraft, flights, [f.path for f in files], own_files["path"].unique().to_list())
    packs = stored_rows.packs()
    intake = read_snapshots([replace(f, packs_stored=packs.get(f.path, 0)) for f in files])
    of_files = flight_files.filter(pl.col("flight_id").is_in(flights))
    inputs_changed = register_unread(ledger, of_files, files, intake.quarantine)
    _check_balance(intake)
    of_flights = pl.col("flight_id").is_in(flights)
    names = {"operator": pl.lit(aircraft[0]), "tail": pl.lit(aircraft[1])}
    rows = with_stored_ids(intake.rows, files).with_columns(**names).filter(of_flights)
    quarantine = _with_flight(with_stored_ids(intake.quarantine, files), carriers).filter(of_flights)
    with_rows = rows.select(ACCOUNT).unique()
    received_at = {path: modified_at(ns) for path, ns in flight_files.select("path", "mtime_ns").iter_rows()}
    missing_rows, new_rows = compare_redelivery(rows, quarantine, *stored_rows.of_present_files(), received_at)
    rows = pl.concat([rows, missing_rows])
    quarantine = pl.concat([quarantine, new_rows])
    result = merge_deliveries([rows, stored_rows.rows(with_rows)], received_at)
    merged_of_files = MergeResult(*(part.join(with_rows, on=ACCOUNT, how="semi") for part in result))
    account = _account(rows, quarantine, merged_of_files)
    noted = pl.concat([quarantine, stored_rows.quarantine()], how="diagonal").filter(n_rows=0)
    of_merge = result.quarantine.join(noted, on=(*ACCOUNT, "reason"), how="anti")
    quarantine = pl.concat([quarantine, of_merge])
    return IngestResult(
        result.rows,
        pl.concat([account, stored_rows.deliveries(result, with_rows)]).group_by(ACCOUNT).sum().with_columns(**names),
        pl.concat([quarantine, stored_rows.quarantine()], how="diagonal").with_columns(**names),
        inputs_changed,
    )


@dataclass(frozen=True)
class StoredRows:
    """Stored rows of some flights from files that left the landing zone, or hold no good row of them any more.

    `present` are the files in the landing zone, `own` those that belong to this airframe, in the zone or not;
    `with_rows` (file, flight_id) of the methods lists their flights with good rows.
    """

    store: Store
    aircraft: tuple[str, str]
    flights: list[str]
    present: list[str]
    own: list[str]

    def _read(self, table: str) -> pl.DataFrame:
        rows = self.store.scan(table, [self.aircraft], self.flights)
        of_flights = pl.col("flight_id").is_in(self.flights) & pl.col("file").is_in(self.own)
        return TABLES[table].conform(rows.filter(of_flights).collect())

    @cached_property
    def _stored_quarantine(self) -> pl.DataFrame:
        """Quarantine of delivered rows; that of computed rows belongs to their own stage."""
        return self._read("raw_quarantine").filter(pl.col("reason") != BREAKS_DECLARATION)

    @cached_property
    def _stored_rows(self) -> pl.DataFrame:
        both = pl.concat([self._read("raw_snapshots"), self._read("raw_logs")])
        return both.with_columns(row_in_file=pl.lit(0, pl.Int64)).select(ROW_COLUMNS)

    def packs(self) -> dict[str, int]:
        """Find the highest pack number of which each file has stored more than a few odd rows."""
        sizes = self._stored_rows.filter(pl.col("file").is_in(self.present)).group_by("file", "pack").len()
        real = sizes.filter(pl.col("len") >= MIN_ROW_SHARE * pl.col("len").max().over("file"))
        return dict(real.group_by("file").agg(pl.col("pack").max()).iter_rows())

    def rows(self, with_rows: pl.DataFrame) -> pl.DataFrame:
        """Return the rows in the columns of `read_snapshots`."""
        return self._stored_rows.join(with_rows, on=ACCOUNT, how="anti")

    def of_present_files(self) -> tuple[pl.DataFrame, pl.DataFrame]:
        """Return rows and quarantine rows of earlier versions of files in the landing zone."""
        here = pl.col("file").is_in(self.present)
        return self._stored_rows.filter(here), self._stored_quarantine.filter(here)

    def quarantine(self) -> pl.DataFrame:
        """Return the quarantine rows of removed files."""
        return self._stored_quarantine.filter(~pl.col("file").is_in(self.present))

    def deliveries(self, merge_result: MergeResult, with_rows: pl.DataFrame) -> pl.DataFrame:
        """Return the account of removed files; rows that a later file has replaced count as duplicates."""
        absent = ~pl.col("file").is_in(self.present)
        accounts = self._read("raw_deliveries").filter(absent).select(*ACCOUNT, "delivered", "quarantined")
        # rows of broken files, or of a killed night
        without_account = count_rows(self.rows(with_rows), None).join(accounts, on=ACCOUNT, how="anti")
        new_accounts = without_account.select(*ACCOUNT, delivered="n", quarantined=pl.lit(0, pl.Int64))
        counts = (
            pl.concat([accounts, new_accounts])
            .join(count_rows(merge_result.rows, None).rename({"n": "loaded"}), on=ACCOUNT, how="left", validate="m:1")
            .join(count_rows(None, merge_result.quarantine), on=ACCOUNT, how="left", validate="m:1")
            .with_columns(pl.col("loaded", "n").fill_null(0))
            .with_columns(pl.col("quarantined") + pl.col("n"))
        )
        duplicate = pl.col("delivered") - pl.col("loaded") - pl.col("quarantined")
        return counts.select(*ACCOUNT, "delivered", "loaded", "quarantined", duplicate=duplicate)


_REGISTERED = ("path", "kind", "size", "mtime_ns", "digest")


def landing_files(landing: Path, ledger_rows: pl.DataFrame) -> list[LandingFile]:
    """List the files of ledger rows that are still in the landing zone, by path."""
    rows = ledger_rows.select(_REGISTERED).unique().sort("path").rows()
    root = str(landing.resolve())
    present = [row for row in rows if os.path.isfile(landing / row[0])]
    return [_landing_file(root, row) for row in present]


def folder_of(path: str) -> tuple[str, str]:
    """Return operator and tail of the folder that holds a file; empty for files of the fleet."""
    parts = path.split("/")
    return (parts[0], parts[1]) if len(parts) > 2 else ("", "")


def with_stored_ids(rows: pl.DataFrame, files: Iterable[LandingFile]) -> pl.DataFrame:
    """Replace the delivered flight_id by the stored one where the airframe had this tail under another operator."""
    prefixes = {f.path: f.tenures[0].prefix for f in files if f.tenures[0].prefix}
    if not prefixes:
        return rows
    prefix = pl.col("file").replace_strict(prefixes, default="", return_dtype=pl.String)
    return rows.with_columns((prefix + pl.col("flight_id")).alias("flight_id"))


def _landing_file(root: str, row: tuple[Any, ...]) -> LandingFile:
    path, kind, size, mtime_ns, digest = row
    registered = Registered.parse(digest)
    return LandingFile(
        root,
        path,
        *folder_of(path),
        kind,
        size,
        mtime_ns,
        context=registered.context,
        content_hash=registered.content_hash,
    )


def register_unread(
    ledger: Ledger,
    ledger_rows: pl.DataFrame,
    files: Iterable[LandingFile],
    quarantine: pl.DataFrame,
    due_at: Mapping[str, datetime] | None = None,
) -> bool:
    """Register as unread the files of ledger rows that were not read as they were registered.

    Their cells are then made of no content, and the scan of a later night finds the files new as soon as it can read
    them. Call it before the cells are marked.

    Parameters
    ----------
    ledger_rows : DataFrame
        Files that were to be read, as the ledger lists them.
    files : iterable of LandingFile
        Those that are in the landing zone.
    quarantine : DataFrame
        Faults that were found in them.
    due_at : mapping of str to datetime, optional
        When files with rows of the future, by path, are to be read again.

    Returns
    -------
    bool
        Whether the ledger lists a file otherwise now.
    """
    not_read = quarantine.filter(pl.col("reason").is_in(UNREAD))["file"]
    read = {file.path for file in files}.difference(not_read)
    changed = []
    for row in ledger_rows.select(_REGISTERED).filter(pl.col("path") != "").unique().rows():
        file = _landing_file("", row)
        registered = Registered.parse(row[-1])
        due = (due_at or {}).get(file.path)
        if file.path in read:
            as_read = registered._replace(due_at=due.isoformat() if due else "")
        else:
            as_read = registered._replace(content_hash="")
        if as_read != registered:
            airframe = file.tenures[0].airframe  # a log may belong to others, too
            changed.append((file.path, *airframe, file.kind, file.size, file.mtime_ns, str(as_read)))
    if changed:
        ledger.register(changed, {})
    return bool(changed)


def _check_balance(intake: Intake) -> None:
    """Check that each file's rows and quarantine rows add up to its count when it was opened."""
    counts = count_rows(intake.rows, intake.quarantine, ["file"])
    sums = intake.delivered.join(counts, on="file", how="left", validate="m:1")
    wrong = sums.filter(pl.col("n_delivered") != pl.col("n").fill_null(0))
    if wrong.height:
        raise ValueError(
            f"rows of {wrong['file'][0]} do not add up:"
            f" {wrong['n_delivered'][0]} delivered, {wrong['n'][0]} accounted for"
        )


def _with_flight(quarantine: pl.DataFrame, carriers: pl.DataFrame) -> pl.DataFrame:
    """Assign rows without a flight to the first flight of their file, so that each is reported once."""
    with_carrier = quarantine.join(carriers, on="file", how="left", validate="m:1")
    return with_carrier.with_columns(pl.coalesce("flight_id", "carrier").alias("flight_id")).drop("carrier")


def _account(rows: pl.DataFrame, quarantine: pl.DataFrame, result: MergeResult) -> pl.DataFrame:
    """Count rows delivered, loaded, quarantined and duplicate for each file and flight; they must balance."""
    counts = {
        "loaded": count_rows(result.rows, None),
        "quarantined": count_rows(None, pl.concat([quarantine, result.quarantine])),
        "duplicate": result.duplicates.rename({"n_duplicate": "n"}),
    }
    account = count_rows(rows, quarantine).rename({"n": "delivered"})
    for name, count in counts.items():
        account = account.join(count.rename({"n": name}), on=ACCOUNT, how="left", validate="m:1")
    return account.with_columns(pl.col(*counts).fill_null(0).cast(pl.Int64)).select(*ACCOUNT, "delivered", *counts)
