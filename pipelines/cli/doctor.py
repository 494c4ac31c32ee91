"""Check an installation, a landing zone and a home."""

import importlib.metadata
import os
import platform
import shutil
import sqlite3
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import duckdb
import polars as pl

from pipelines.digest.declaration import NotifyError, receivers_of
from pipelines.intake.faults import REASONS, ignored_entries, refused_logs, silent_columns, silent_lines
from pipelines.intake.findings import NAME as NAME_OF_COSTS
from pipelines.intake.findings import CostError, read_costs
from pipelines.intake.held import HELD_GROUPS, held_flights, held_lines
from pipelines.intake.landing import list_landing
from pipelines.intake.landing_file import LandingFile
from pipelines.intake.readers import TYPES, readers
from pipelines.intake.scan import list_new_files
from pipelines.intake.snapshots import read_snapshots
from pipelines.lineage import FLIGHT_FILES
from pipelines.orchestration.around_night import find_landing_fault
from pipelines.repair import find_history_fault
from pipelines.report.tasks import NAME as NAME_OF_TASKS
from pipelines.report.tasks import read_tasks
from pipelines.storage.cases import CaseLog
from pipelines.storage.catalog import CATALOG, connect
from pipelines.storage.catalog_checks import find_staleness
from pipelines.storage.database import DatabaseError
from pipelines.storage.ledger import FILE, Ledger
from pipelines.storage.ledger_copy import find_ledger_fault
from pipelines.storage.objects import StoreError
from pipelines.storage.seal import CYCLE, NAME, changed_files, name_files, read_seal
from pipelines.storage.settings import notify_file
from pipelines.storage.store import Store
from pipelines.storage.view_headers import views

_NEEDED_GB = 1.0
FILES_A_FOLDER = 3
"""Files of a folder of an aircraft that are checked: the oldest and the newest."""
NEW_FILES = 1_000
"""Files that no night has read yet that are checked besides, the last written first."""
_FILES_AT_ONCE = 100  # in memory


@dataclass(frozen=True, slots=True)
class Check:
    """A check's name, whether it passed, and its result in words."""

    name: str
    well: bool
    message: str


def examine(landing: Path | None, home: Path | None) -> Iterator[Check]:
    """Check the installation, and the folders that are given."""
    if home is not None and (home / CATALOG).exists():
        yield from _logs(home)
    yield Check("python", sys.version_info >= (3, 11), f"{platform.python_version()}, {os.cpu_count()} cores")
    yield from _packages()
    if landing is not None:
        yield from _landing(landing, home)
        if TYPES in readers():
            yield from (Check(*result) for result in readers()[TYPES].checks(landing.resolve()))
    if home is not None:
        yield from _home(home)


def _packages() -> Iterator[Check]:
    needed = ("dagster", "polars", "duckdb", "scipy", "filterpy", "pyarrow", "scikit-learn")
    slower = "not installed, fits use the slower NumPy path; pip install 'hybrid-digital-twin[speed]'"
    for name, without in {**dict.fromkeys(needed, "missing; install the project again"), "numba": slower}.items():
        try:
            yield Check(name, True, importlib.metadata.version(name))
        except importlib.metadata.PackageNotFoundError:
            yield Check(name, name not in needed, without)


def _landing(landing: Path, home: Path | None) -> Iterator[Check]:
    """Check names in the landing zone, and the contents of new files and of a few of each aircraft."""
    if fault := find_landing_fault(landing):
        yield Check("landing zone", False, fault)
        return
    listing = list_landing(landing)
    files = len(listing.files)
    refused = listing.quarantine
    message = f"{files} files to read, {refused.height} with unknown names"
    message += f": {'; '.join(ignored_entries(refused))}" if refused.height else ""
    well = files > 0 and refused.is_empty()
    yield Check("landing zone", well, message if files else f"{message}; `hdt docs raw-data` shows the layout")
    if unlisted := sorted({f"{f.operator} {f.tail}" for f in listing.files if not f.in_fleet_list}):
        yield Check("fleet list", False, f"fleet.csv lacks {', '.join(unlisted)}")
    new = list_new_files(landing, Ledger(home, read_only=True))[1] if home else listing.files
    newest = sorted((f for f in new if f.kind in FLIGHT_FILES), key=lambda f: f.mtime_ns, reverse=True)[:NEW_FILES]
    sample = {f.path: f for f in (*newest, *sample_files(listing.files))}
    faults = check_contents([*sample.values()])
    yield Check("contents", not faults, "; ".join(faults) or f"{len(sample)} files sampled, columns as agreed")


def sample_files(files: Iterable[LandingFile]) -> list[LandingFile]:
    """Select the oldest and newest files of flights in each folder of an aircraft, of recordings one."""
    folders: dict[str, list[LandingFile]] = {}
    for file in sorted(files, key=lambda f: (f.name[-16:], f.path)):
        if file.kind in FLIGHT_FILES:
            folders.setdefault(file.path.rpartition("/")[0], []).append(file)
    return [f for own in folders.values() for f in _oldest_and_newest(own)]


def _oldest_and_newest(files: list[LandingFile]) -> list[LandingFile]:
    newest = files[-1:] if files[-1].is_recording else files[1 - FILES_A_FOLDER :]
    return newest if files[-1].is_recording or len(files) < FILES_A_FOLDER else [files[0], *newest]


def check_contents(files: list[LandingFile]) -> list[str]:
    """List files of which nothing could be stored, and each silent column; nothing is stored."""
    with duckdb.connect() as con:
        con.execute("create schema tables")
        refused = [
            _load(con, files[start : start + _FILES_AT_ONCE]) for start in range(0, max(len(files), 1), _FILES_AT_ONCE)
        ]
        con.execute(views()["silent_columns"])
        return [*ignored_entries(pl.concat(refused)), *silent_lines(silent_columns(con))]


def _load(con: duckdb.DuckDBPyConnection, files: list[LandingFile]) -> pl.DataFrame:
    """Load accounts and quarantine rows of some files into the tables that the view reads.

    Returns
    -------
    DataFrame
        Quarantine rows of the files without a good row: `file, detail`, one of each file.
    """
    intake = read_snapshots(files)
    both = pl.concat([intake.rows.select("file", "flight_id"), intake.quarantine.select("file", "flight_id")])
    flights = both.drop_nulls().group_by("file").agg(pl.col("flight_id").max())
    names = dict.fromkeys(("file", "operator", "tail"), pl.String)
    place = pl.DataFrame([(f.path, f.operator, f.tail) for f in files], schema=names, orient="row")
    accounts = place.join(intake.delivered.rename({"n_delivered": "delivered"}), on="file", validate="1:1")
    accounts = accounts.join(flights, on="file", how="left", validate="1:1")
    for table, frame in (("raw_deliveries", accounts), ("raw_quarantine", intake.quarantine)):
        con.register("frame", frame)
        con.execute(f"create table if not exists tables.{table} as select * from frame limit 0")
        con.execute(f"insert into tables.{table} select * from frame")
    refused = intake.quarantine.filter(~pl.col("file").is_in(intake.rows["file"].unique().implode()))
    sentence = pl.col("reason").replace({code: reason.sentence for code, reason in REASONS.items()})
    return refused.filter(pl.col("scope") != "note").select("file", detail=sentence).unique("file")


def _home(home: Path) -> Iterator[Check]:
    near = next(p for p in (home, *home.resolve().parents) if p.exists())
    writable = os.access(near, os.W_OK)
    yield Check("home", writable, f"{home} is {'' if writable else 'not '}writable")
    free_gb = shutil.disk_usage(near).free / 1e9
    yield Check("disk", free_gb >= _NEEDED_GB, f"{free_gb:.0f} GB free, at least {_NEEDED_GB:.0f} GB needed")
    yield _check_read("costs", _costs, home)
    yield _check_read("work", _tasks, home)
    yield from _stored(home)
    if os.path.lexists(notify_file(home)):
        yield _check_read("receivers", _receivers, home)
    if (home / CATALOG).exists():
        catalog = _catalog(home)
        yield catalog
        if catalog.well:
            yield _feed(home)
            yield _record(home)


def _logs(home: Path) -> Iterator[Check]:
    """Check that no log is refused as a whole: without it no failure is on record."""
    try:
        with connect(home) as con:
            refused = refused_logs(con)
    except (OSError, duckdb.Error):  # a catalog that can't be read is checked below
        return
    if refused:
        yield Check("logs", False, "; ".join(refused))


def _check_read(name: str, read: Callable[[Path], str], home: Path) -> Check:
    """Check what `read` reads from a home and describes."""
    try:
        return Check(name, True, read(home))
    except (CostError, NotifyError, StoreError) as error:
        return Check(name, False, str(error))


def _receivers(home: Path) -> str:
    return f"{', '.join(r.name for r in receivers_of(home)) or 'none'}; `hdt digest --try` sends to each"


def _costs(home: Path) -> str:
    own = read_costs(home).filter(source=NAME_OF_COSTS).height
    return f"{own} of the home's own" if own else f"defaults; {NAME_OF_COSTS} in the home sets yours"


def _tasks(home: Path) -> str:
    read_tasks(home)
    return NAME_OF_TASKS if (home / NAME_OF_TASKS).exists() else f"examples; {NAME_OF_TASKS} in the home sets yours"


def _stored(home: Path) -> Iterator[Check]:
    """Check ledger, case log, history and tables against their seals; reads every file."""
    ledger = Ledger(home, read_only=True)
    if (home / FILE).exists() or (home / NAME).exists():
        fault = find_ledger_fault(ledger)
        yield Check("ledger", fault is None, f"it {fault}; {_NIGHT} repairs it" if fault else "ok")
    yield from _cases(home)
    if (home / "dagster").is_dir():
        fault = find_history_fault(home)
        yield Check("history", fault is None, f"{fault}; `hdt tidy` begins a new one" if fault else "ok")
    store = Store(home.resolve())
    seal = read_seal(home)
    if not store.place.remote and (seal or (home / CATALOG).exists()):
        damaged = changed_files(store, seal, seal.files, whole=True) if seal else [NAME]
        message = (
            f"{name_files(damaged)} missing or changed since written; {_repair_by_night(store)}" if damaged else ""
        )
        yield Check("tables", not damaged, message or f"all {len(seal.files) if seal else 0} files unchanged")


def _cases(home: Path) -> Iterator[Check]:
    """Check the log of cases against the copy that the tables hold up to the last night."""
    try:
        fault = CaseLog(home).fault(Store(home.resolve()).read_table("raw_cases"))
    except StoreError as error:
        fault = f"can't be compared ({error})"
    if fault:
        yield Check("cases", False, f"the log of cases {fault}; {_NIGHT} repairs it")


def _repair_by_night(store: Store) -> str:
    """Mark the store for a full check in the next night; return when that repairs it."""
    store.place.mark_suspect()
    when = "" if store.place.suspect else f" within {CYCLE} nights, as this user can't write the mark into the home"
    return f"{_NIGHT} writes it again{when}"


_NIGHT = "`hdt nightly`"


def _catalog(home: Path) -> Check:
    try:
        with connect(home) as con:
            present = con.execute("select view_name from duckdb_views() where not internal").fetchall()
        stale = find_staleness(home)
    except (StoreError, DatabaseError, sqlite3.Error) as error:
        return Check("catalog", False, str(error))
    if stale:
        return Check("catalog", False, f"{stale}; {_NIGHT} publishes it again")
    missing = sorted(set(views()) - {name for (name,) in present})
    return Check("catalog", not missing, f"lacks {', '.join(missing)}" if missing else f"all {len(views())} views")


_MISWRITTEN = """
select file || ': ' || string_agg(distinct coalesce(column_name || ' ', '') || replace(reason, '_', ' '), '; ')
from quarantine where reason in ('wrong_unit', 'one_channel', 'swapped_columns', 'unit_kelvin', 'unit_kpa', 'unit_kg_s',
    'implausible_pressure', 'tail_of_two_operators') group by file order by max(received_at) desc, file
"""


def _feed(home: Path) -> Check:
    """Check for files in other units or wiring than agreed, and for silent columns."""
    try:
        with connect(home) as con:
            odd = [line for (line,) in con.execute(_MISWRITTEN).fetchall()]
            silent = silent_lines(silent_columns(con))
    except StoreError as error:
        return Check("units and wiring", False, str(error))
    more = f" and {len(odd) - 3} more files" if len(odd) > 3 else ""
    lines = [f"{'; '.join(odd[:3])}{more}; see `select * from quarantine`"] if odd else []
    return Check("units and wiring", not odd + silent, "; ".join([*lines, *silent]) or "physically consistent")


def _record(home: Path) -> Check:
    """Check for flights that are held."""
    try:
        with connect(home) as con:
            lines_of_held = held_lines(held_flights(con, HELD_GROUPS))
    except StoreError as error:
        return Check("record", False, str(error))
    return Check("record", not lines_of_held, "; ".join(lines_of_held) or "no flight is held")
