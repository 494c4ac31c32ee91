"""Repair a home whose stored files changed since the last night: report each damage in a line and have it made again.

A file that is missing or changed is removed from its table and its cells become stale; a damaged log is rebuilt from
the files. Of a computed stage all tables of an aircraft go together, since it continues from what it has stored.
Disks flip bits and keep size and time: a night reads a share of all files, and all of them after it met a damaged one.

Dagster's history is SQLite files, on which no stored result depends. Every run has a file of its own, thousands in a
year, that nobody writes once the run has ended: `hdt doctor` and `hdt tidy` read these too, a night only the others.
"""

import re
import shutil
from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory

import polars as pl

from hdt_core.tables import TABLES
from pipelines.intake.findings import CASES, COSTS, FINDINGS
from pipelines.lineage import MAKER, Stage
from pipelines.storage import seal
from pipelines.storage.cases import CaseLog
from pipelines.storage.database import query_value
from pipelines.storage.delta import DamageError, shards_of
from pipelines.storage.files import LOG, hash_in
from pipelines.storage.ledger import Ledger
from pipelines.storage.ledger_copy import repair_ledger
from pipelines.storage.store import EMPTY, FLEET, Aircraft, Store, in_shard, without_folded


def repair_home(landing: Path, store: Store, ledger: Ledger) -> list[str]:
    """Make damaged cells stale and restore the log of cases; a line for each damage."""
    lines = _repair_tables(landing, store, ledger)
    line = CaseLog(store.home).repair(store.read_table("raw_cases"))  # of tables that are whole again
    return [*lines, line] if line else lines


def _repair_tables(landing: Path, store: Store, ledger: Ledger) -> list[str]:
    lines = [fault] if (fault := repair_ledger(ledger)) else []
    if store.place.remote:
        return lines
    last_seal = seal.read_seal(store.home)
    if last_seal is None and ledger.snapshots():
        lines.append(f"{seal.NAME} was gone or damaged: every table was read whole")
    paths_damaged = _damaged_since(store, last_seal, ledger) if last_seal else _damaged_without_seal(store, ledger)
    for table, paths in groupby(sorted(paths_damaged), key=lambda path: path.split("/")[0]):
        lines += _repair_table(landing, store, ledger, table, list(paths), last_seal)
    if last_seal and paths_damaged:
        seal.remove_entries(
            store, last_seal, set(paths_damaged), {path.split("/")[0] for path in paths_damaged if seal.is_log(path)}
        )
    store.place.clear_suspicion()
    return lines


def _damaged_since(store: Store, last_seal: seal.Seal, ledger: Ledger) -> list[str]:
    """Find sealed files that changed: by size and time; this night's turn by content, all in a suspect home."""
    to_read = seal.files_to_read(last_seal.files, ledger.nights().height)
    logs = list[str]()
    if store.place.suspect:
        logs = [f"{table}/{LOG}" for table in TABLES if not _has_readable_log(store, table)]
        to_read = set(last_seal.files)
        for hint in Path(store.place.url).glob(f"*/{LOG}/{seal.HINT}"):
            hint.unlink()  # it is not sealed, and a wrong one keeps a log from being read
    others = (path for path in last_seal.files if path not in to_read)
    return [
        *logs,
        *seal.changed_files(store, last_seal, others),
        *seal.changed_files(store, last_seal, sorted(to_read), whole=True),
    ]


def _has_readable_log(store: Store, table: str) -> bool:
    try:
        store.tables.shards(table)
    except DamageError:
        return False
    return True


def _damaged_without_seal(store: Store, ledger: Ledger) -> list[str]:
    """Find damaged files where there is no seal: read every table, which must be as new as on record."""
    versions = ledger.snapshots()
    if not (store.home / seal.NAME).exists() and not versions:
        return []  # no night has ended yet
    newest = {table: max((night.get(table, -1) for night in versions.values()), default=-1) for table in TABLES}
    return [path for table in TABLES for path in _damaged_of_table(store, table, newest[table])]


def _damaged_of_table(store: Store, table: str, newest: int) -> list[str]:
    try:
        log = store.tables.open(table)
        files = shards_of(log).values() if log is not None else ()
    except DamageError:
        return [f"{table}/{LOG}"]
    if log is None or log.version() < newest:
        return [f"{table}/{LOG}"] if newest >= 0 else []
    return seal.changed_files(store, None, [f"{table}/{file}" for file in files], whole=True)


def _repair_table(
    landing: Path, store: Store, ledger: Ledger, table: str, paths: list[str], last_seal: seal.Seal | None
) -> Iterator[str]:
    sealed_files = last_seal.tables.get(table) if last_seal else None
    if any(seal.is_log(path) for path in paths):
        if not _rebuild_log(store, table, sealed_files):
            _remove_shards(store, MAKER[table])
        ledger.delete_cells(MAKER[table].tables)
        ledger.delete_snapshots_of(table)
        yield f"the log of {table} was damaged: written anew, and {MAKER[table].name} is made again"
    current = {f"{table}/{file}" for file in store.tables.shards(table).values()}.union(sealed_files or ())
    files = [path for path in paths if not seal.is_log(path)]
    current_damaged = [path for path in files if path in current]
    missing_deliveries = set[str]()
    store.tables.remove_files(table, [path.removeprefix(f"{table}/") for path in current_damaged])
    for path in files:  # of no use to anybody, and found again otherwise
        (Path(store.place.url) / path).unlink(missing_ok=True)
    for path in current_damaged:
        shard = path.removeprefix(f"{table}/").rsplit(".", 2)[0]
        missing_deliveries |= _make_stale(landing, store, ledger, table, shard)
    if current_damaged:
        yield f"{len(current_damaged)} of {len(current)} files of {table} were missing or changed: made again"
    if earlier := set(files).difference(current_damaged):
        yield f"{len(earlier)} files of earlier nights of {table} were missing or changed"
    if missing_deliveries:
        names = ", ".join(sorted(missing_deliveries))
        yield f"their rows came from files that have left the landing zone, put them back: {names}"


def _make_stale(landing: Path, store: Store, ledger: Ledger, table: str, shard: str) -> set[str]:
    """Make the cells of a shard stale; the delivered files they need that are not in the landing zone."""
    folder, _, name = shard.rpartition("/")
    if name == EMPTY:
        return set()
    aircraft = (folder.split("/")[0], folder.split("/")[1]) if folder else FLEET
    stage = MAKER[name.removeprefix("aside_") if name.startswith("aside_") else table]
    flights = _flights(ledger, table, aircraft, name) if stage is MAKER[table] else None
    ledger.delete_cells(stage.tables, aircraft, flights)
    if stage.group == "raw":
        return _missing_deliveries(landing, ledger, stage, aircraft, flights)
    _remove_shards(store, stage, f"{folder}/" if folder else "fleet")
    return set()


def _remove_shards(store: Store, stage: Stage, prefix: str = "") -> None:
    """Have a computed stage start afresh, for all or one aircraft; one that goes flight by flight does so anyway."""
    for table in stage.tables if stage.grain != "flight" and stage.group != "raw" else ():
        shards = store.tables.shards(table).items()
        store.tables.remove_files(table, [f for s, f in shards if s.startswith(prefix) and s != EMPTY])


def _flights(ledger: Ledger, table: str, aircraft: Aircraft, name: str) -> list[str] | None:
    """List the flights of a shard; None for tables that are not by flight."""
    if TABLES[table].grain != "flight":
        return None
    cells = ledger.of([aircraft]).cells(table).filter(operator=aircraft[0], tail=aircraft[1])
    return cells.with_columns(TABLES[table].shard_of).filter(in_shard(name))["flight_id"].to_list()


def _missing_deliveries(
    landing: Path, ledger: Ledger, stage: Stage, aircraft: Aircraft, flights: Iterable[str] | None
) -> set[str]:
    of_aircraft = ledger.of([aircraft])
    kinds = {kind for recipe in stage.tables.values() for kind in recipe.files} - {CASES, FINDINGS, COSTS}
    files = of_aircraft.flight_files() if flights is not None else of_aircraft.files(kinds)
    files = files.filter(pl.col("kind").is_in(kinds), operator=aircraft[0], tail=aircraft[1])
    if flights is not None:
        files = files.filter(pl.col("flight_id").is_in(list(flights)))
    return {path for path in files["path"].unique() if not (landing / path).is_file()}


def _rebuild_log(store: Store, table: str, sealed_files: list[str] | None) -> bool:
    """Write a table's log anew, over the files of the last night or else the last whole file of each shard.

    Whether the files of the last night are on record and whole.
    """
    root = Path(store.place.url) / table
    shutil.rmtree(root / LOG, ignore_errors=True)
    on_disk = sorted(root.rglob("[!.]*.parquet"), key=lambda path: path.stat().st_mtime_ns)
    paths = [str(path.relative_to(store.place.url)) for path in on_disk] if sealed_files is None else sealed_files
    changed_paths = seal.changed_files(store, None, paths, whole=True)
    whole = [path.removeprefix(f"{table}/") for path in paths if path not in changed_paths]
    shards = {f.removesuffix(f".{hash_in(f)}.parquet"): f for f in whole if hash_in(f)}
    for _, own in groupby(sorted(shards.items()), key=lambda item: item[0].rpartition("/")[0]):
        frames = {shard: pl.read_parquet(root / file) for shard, file in own}
        store.tables.write(table, without_folded(TABLES[table], frames))
    return sealed_files is not None and not changed_paths


_READ_BYTES = 256 << 20  # a larger file is not read whole by a night
_ASIDE = "dagster.damaged"
_RUN_ID = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")


def find_history_fault(home: Path, *, whole: bool = True) -> str | None:
    """Find the first damaged file of all, each read whole, or of those that all runs share; the fault in words."""
    files = (f for f in sorted((home / "dagster").rglob("*.db")) if whole or not _RUN_ID.fullmatch(f.stem))
    return next(filter(None, (_file_fault(home, file, whole=whole) for file in files)), None)


def _file_fault(home: Path, file: Path, *, whole: bool) -> str | None:
    large = file.stat().st_size > _READ_BYTES and not whole
    answer = _query(file, "select count(*) from sqlite_master" if large else "pragma quick_check(1)")
    intact = answer == "ok" or (large and answer.isdigit())
    return None if intact else f"{file.relative_to(home)} is damaged ({answer.splitlines()[0]})"


def _query(file: Path, sql: str) -> str:
    """Query a file, or a copy of it where there is a write-ahead log, into which a reader would write."""
    log = file.with_name(f"{file.name}-wal")
    if not (log.exists() and log.stat().st_size):
        return query_value(file, sql)
    with TemporaryDirectory() as folder:
        for one in (file, log):
            shutil.copyfile(one, Path(folder, one.name))
        return query_value(Path(folder, file.name), sql)


def replace_damaged_history(home: Path, *, whole: bool = True) -> str | None:
    """Begin a new history where the old one is damaged; the fault in words. A night does not read it `whole`."""
    fault = find_history_fault(home, whole=whole)
    if fault is None:
        return None
    place = next(p for n in range(1_000_000) if not (p := home / (f"{_ASIDE}.{n}" if n else _ASIDE)).exists())
    settings = home / "dagster" / "dagster.yaml"
    content = settings.read_bytes() if settings.exists() else None
    (home / "dagster").rename(place)
    if content is not None:
        settings.parent.mkdir()
        settings.write_bytes(content)
    return f"{fault}; Dagster's history begins anew, the old one is {place.name}"
