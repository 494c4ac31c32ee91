"""Ingest records as typed SI rows without duplicates, and account for every delivered row."""

from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import polars as pl

from hdt_core.alerts.answers import with_findings
from hdt_core.record.facts import flight_facts
from hdt_core.records.unit_index import date_entries
from hdt_core.tables.raw import CASE, RawChecks
from pipelines.assets.stage import StageResult, stage
from pipelines.intake.airframes import add_airframes, with_airframe
from pipelines.intake.faults import NO_FAULTS, quarantine
from pipelines.intake.findings import NAME as COSTS_FILE
from pipelines.intake.findings import costs_or_fault
from pipelines.intake.ingest import ingest_flights, landing_files, register_unread
from pipelines.intake.kept_lines import keep_lines
from pipelines.intake.landing import list_landing
from pipelines.intake.landing_file import FileIntake, LandingFile
from pipelines.intake.logs import is_done, or_stored, read_checks, read_fleet, read_maintenance, read_messages
from pipelines.intake.readers import REPORTS, TYPES, readers
from pipelines.intake.scan import WITHOUT_FLIGHT
from pipelines.intake.snapshots import read_snapshots
from pipelines.lineage import LINEAGE, STAGE
from pipelines.resources import Home, PartitionScope
from pipelines.storage.cases import CaseLog, with_ids


@stage
def raw_fleet(home: Home) -> StageResult:
    """Read the fleet list, checks and costs, and account for files without a flight."""
    landing = Path(home.landing)
    ledger = home.ledger
    now = datetime.now(UTC)
    stored = home.store.read_table("raw_fleet")
    listing = ledger.files(["fleet", "checks", WITHOUT_FLIGHT])
    files = landing_files(landing, listing)
    lists = [(f, add_airframes(f, or_stored(read_fleet(f, now), stored))) for f in files if f.kind == "fleet"]
    fleet = lists[0][1].rows if lists else stored  # a missing list removes no aircraft
    checks = [(f, _checks(f, now, home)) for f in files if f.kind == "checks"]
    costs, cost_faults = costs_or_fault(Path(home.home))
    without_flight = read_snapshots([f for f in files if f.kind == WITHOUT_FLIGHT])
    own_quarantine = pl.concat([without_flight.quarantine, *(x.quarantine for _, x in lists + checks)])
    inputs_changed = register_unread(ledger, listing, files, own_quarantine, due_times(lists + checks))
    accounts = without_flight.delivered.select(
        "file", delivered="n_delivered", loaded=0, quarantined="n_delivered", duplicate=0
    )
    quarantines = [list_landing(landing).quarantine, own_quarantine]
    frames = (
        fleet,
        pl.concat([accounts, *(account(f, x) for f, x in lists + checks)], how="vertical_relaxed"),
        pl.concat([*quarantines, quarantine(COSTS_FILE, now, cost_faults)]),
        readers()[TYPES].coverage(landing.resolve()) if TYPES in readers() else home.store.read_table("raw_coverage"),
        pl.concat([RawChecks.create_empty(), *(x.rows for _, x in checks)], how="diagonal_relaxed").unique(),
        costs,
    )
    return StageResult(frames, {}, inputs_changed)


def _checks(file: LandingFile, now: datetime, home: Home) -> FileIntake:
    """Read planned checks; a file that can't be read cancels none that is stored, one without a line does."""
    intake = read_checks(file, now)
    return or_stored(intake, home.store.read_table("raw_checks")) if intake.quarantine.height else intake


@stage
def raw_records(scope: PartitionScope, home: Home) -> StageResult:
    """Read messages, maintenance entries with the findings of cases, and heads of printed reports."""
    listing = home.ledger.of(scope.aircraft or {}).files([*RECORDS, REPORTS])
    landing = Path(home.landing)
    files = landing_files(landing, listing)
    of_logs = PartitionScope({t.airframe: [] for f in files for t in f.tenures} | (scope.aircraft or {}))
    stored = {
        table: (of_logs if table in _LINES else scope).read_table(home.store, table)
        for table in STAGE["raw_records"].tables
    }
    stored["raw_maintenance"] = pl.concat(
        # the case log has findings
        [stored["raw_maintenance"].filter(pl.col("source") != CASE), stored["raw_maintenance_not_done"]],
        how="diagonal",
    )
    for kind in RECORDS:  # rows stored by earlier versions name no file
        file = pl.concat_str("operator", pl.lit("/"), "tail", pl.lit(f"/{kind}.csv"))
        stored[f"raw_{kind}"] = stored[f"raw_{kind}"].with_columns(pl.coalesce("file", file).alias("file"))
    logs = [*_logs(files, stored), *_printed(files, listing, stored["raw_reports"])]
    log_quarantine = pl.concat([NO_FAULTS, *(x.quarantine for _, x in logs)])
    inputs_changed = register_unread(home.ledger, listing, files, log_quarantine, due_times(logs))
    rows_of = {kind: [with_airframe(x.rows, f) for f, x in logs if f.kind == kind] for kind in (*RECORDS, REPORTS)}

    def with_stored(table: str, frames: list[pl.DataFrame]) -> pl.DataFrame:
        """Add the stored rows of files that left the landing zone; of a file of two airframes, rows of the run's."""
        left = set(listing["path"]) - {f.path for f, _ in logs}
        rows = pl.concat([stored[table].filter(pl.col("file").is_in(left)), *frames], how="diagonal")
        return rows.join(scope.cells(), on=list(_AIRCRAFT), how="semi", maintain_order="left")

    messages, maintenance = (_each_once(with_stored(f"raw_{kind}", rows_of[kind])) for kind in RECORDS)
    deliveries = [with_aircraft(f, account(f, x)) for f, x in logs]
    frames = (
        messages,
        date_entries(with_findings(maintenance.filter(is_done()), case_lines(scope, home))),
        date_entries(maintenance.filter(~is_done())),
        with_stored("raw_reports", rows_of[REPORTS]),
        with_stored("raw_records_deliveries", deliveries).with_columns(_ROW_COUNTS),
        with_stored("raw_records_quarantine", [with_aircraft(f, x.quarantine) for f, x in logs]),
    )
    return StageResult(frames, {}, inputs_changed)


RECORDS = {"messages": read_messages, "maintenance": read_maintenance}
_LINES = ("raw_messages", "raw_maintenance", "raw_maintenance_not_done")
"""Tables of lines that are compared with a log as a whole, which may belong to several airframes."""
_AIRCRAFT = {"operator": pl.String, "tail": pl.String}
_ROW_COUNTS = pl.col("delivered", "loaded", "quarantined", "duplicate").fill_null(0)
_Logs = list[tuple[LandingFile, FileIntake]]


def due_times(logs: _Logs) -> dict[str, datetime]:
    """Map the files with rows of the future to the time at which the first of them can be stored."""
    return {file.path: intake.due_at for file, intake in logs if intake.due_at}


def _logs(files: list[LandingFile], stored: Mapping[str, pl.DataFrame]) -> _Logs:
    """Read messages and maintenance, one file an aircraft, with stored lines that a shorter log leaves be.

    Packs already stored keep their numbers.
    """
    logs = _Logs()
    now = datetime.now(UTC)
    for file in (f for f in files if f.kind != REPORTS):
        own = stored[f"raw_{file.kind}"].filter(file=file.path)
        with_packs = replace(file, packs_stored=own.select(pl.col("pack").max()).item() or 0)
        log = RECORDS[file.kind](with_packs, now)
        logs.append((with_packs, keep_lines(file, replace(log, rows=with_airframe(log.rows, file)), own)))
    return logs


def _printed(files: list[LandingFile], listing: pl.DataFrame, stored: pl.DataFrame) -> _Logs:
    """Read printed reports whose present version is not stored; there is one a flight."""
    version = pl.concat_str("digest", pl.lit(f".{LINEAGE['raw_reports'].code}")).alias("version")
    unread = listing.filter(pl.col("kind") == REPORTS).with_columns(version)
    unread = unread.join(stored.select(path="file", version="file_version"), on=["path", "version"], how="anti")
    versions = dict(unread.select("path", "version").rows())
    now = datetime.now(UTC)
    if REPORTS not in readers():
        return []
    logs = [(f, readers()[REPORTS].read_printed(f, now, versions[f.path])) for f in files if f.path in versions]
    return [(f, replace(x, quarantine=pl.concat([x.quarantine, f.quarantine(f.find_change())]))) for f, x in logs]


def _each_once(rows: pl.DataFrame) -> pl.DataFrame:
    """Drop lines that a log repeats of the log under an earlier operator or tail."""
    return rows.unique([c for c in rows.columns if c != "file"], keep="first", maintain_order=True)


def case_lines(scope: PartitionScope, home: Home) -> pl.DataFrame:
    """Return case log entries of these aircraft, with stored ones in case the log is lost."""
    stored = with_ids(scope.read_table(home.store, "raw_cases"))
    rows = pl.concat([CaseLog(Path(home.home)).entries(), stored], how="diagonal")
    own = rows.unique("id", keep="first", maintain_order=True).join(scope.cells(), on=list(_AIRCRAFT), how="semi")
    return own.sort("line", "at")


@stage
def raw_cases(scope: PartitionScope, home: Home) -> pl.DataFrame:
    """Copy the log of cases, with the lines that followed cases to alerts that moved."""
    return case_lines(scope, home)


def with_aircraft(file: LandingFile, frame: pl.DataFrame) -> pl.DataFrame:
    """Add the key of the file's airframe, of several the first, to `frame`."""
    operator, tail = file.tenures[0].airframe
    return frame.with_columns(operator=pl.lit(operator), tail=pl.lit(tail))


def account(file: LandingFile, intake: FileIntake) -> pl.DataFrame:
    """Count one file's delivered, loaded, quarantined and duplicate rows."""
    counts = {
        "delivered": intake.n_delivered, "loaded": intake.n_loaded,
        "quarantined": intake.n_quarantined, "duplicate": intake.n_duplicate,
    }  # fmt: skip
    return pl.DataFrame({"file": [file.path]} | {k: [v] for k, v in counts.items()})


@stage
def raw(scope: PartitionScope, home: Home) -> StageResult:
    """Ingest snapshot reports and continuous logs of each flight, from every file that holds it."""
    landing = Path(home.landing)
    aircraft = (scope.aircraft or {}).items()
    intakes = [ingest_flights(landing, home.store, home.ledger, a, flights) for a, flights in aircraft]
    rows = pl.concat([t.rows for t in intakes])
    frames = (
        rows.filter(pl.col("source") == "acms"),
        rows.filter(pl.col("source") == "cpl"),
        pl.concat([t.deliveries for t in intakes]),
        pl.concat([t.quarantine for t in intakes], how="diagonal_relaxed"),
        flight_facts(rows),
    )
    return StageResult(frames, {}, any(t.inputs_changed for t in intakes))
