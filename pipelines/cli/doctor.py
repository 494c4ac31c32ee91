"""Check an installation, a landing zone and a home."""

import importlib.metadata
import os
import platform
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from pipelines.digest import NotifyError, receivers_of
from pipelines.intake.costs import NAME as NAME_OF_COSTS
from pipelines.intake.costs import CostError, read_costs
from pipelines.intake.landing import list_landing
from pipelines.intake.landing_sample import silent_in_landing
from pipelines.intake.readers import TYPES, readers
from pipelines.intake.refusals import ignored_entries, silent_columns, silent_lines
from pipelines.storage import history
from pipelines.storage.cases import CaseLog
from pipelines.storage.catalog import CATALOG, connect
from pipelines.storage.ledger import Ledger
from pipelines.storage.ledger_copy import find_ledger_fault
from pipelines.storage.ledger_tables import FILE
from pipelines.storage.objects import StoreError
from pipelines.storage.publication import views
from pipelines.storage.seal import CYCLE, NAME, changed_files, name_files, read_seal
from pipelines.storage.settings import notify_file
from pipelines.storage.store import Store
from pipelines.zone import find_landing_fault

_NEEDED_GB = 1.0


@dataclass(frozen=True, slots=True)
class Check:
    """A check's name, whether it passed, and its result in words."""

    name: str
    well: bool
    message: str


def examine(landing: Path | None, home: Path | None) -> Iterator[Check]:
    """Check the installation, and the folders that are given."""
    yield Check("python", sys.version_info >= (3, 11), f"{platform.python_version()}, {os.cpu_count()} cores")
    yield from _packages()
    if landing is not None:
        yield from _landing(landing)
        if TYPES in readers():
            yield from (Check(*result) for result in readers()[TYPES].checks(landing.resolve()))
    if home is not None:
        yield from _home(home)


def _packages() -> Iterator[Check]:
    for name in ("dagster", "polars", "duckdb", "scipy", "filterpy", "pyarrow", "scikit-learn"):
        try:
            yield Check(name, True, importlib.metadata.version(name))
        except importlib.metadata.PackageNotFoundError:
            yield Check(name, False, "missing; install the project again")
    try:
        yield Check("numba (optional)", True, importlib.metadata.version("numba"))
    except importlib.metadata.PackageNotFoundError:
        message = "not installed, fits use the slower NumPy path; pip install 'hybrid-digital-twin[speed]'"
        yield Check("numba (optional)", True, message)


def _landing(landing: Path) -> Iterator[Check]:
    """Check names in the landing zone, and the contents of a few files of each aircraft."""
    if fault := find_landing_fault(landing):
        yield Check("landing zone", False, fault)
        return
    listing = list_landing(landing)
    files, refused = len(listing.files), listing.quarantine
    message = f"{files} files to read, {refused.height} with unknown names"
    message += f": {'; '.join(ignored_entries(refused))}" if refused.height else ""
    well = files > 0 and refused.is_empty()
    yield Check("landing zone", well, message if files else f"{message}; `hdt docs raw-data` shows the layout")
    n_sampled, silent = silent_in_landing(landing, datetime.now(UTC))
    yield Check("contents", not silent, "; ".join(silent) or f"{n_sampled} files sampled, columns as agreed")


def _home(home: Path) -> Iterator[Check]:
    near = next(p for p in (home, *home.resolve().parents) if p.exists())
    writable = os.access(near, os.W_OK)
    yield Check("home", writable, f"{home} is {'' if writable else 'not '}writable")
    free_gb = shutil.disk_usage(near).free / 1e9
    yield Check("disk", free_gb >= _NEEDED_GB, f"{free_gb:.0f} GB free, at least {_NEEDED_GB:.0f} GB needed")
    yield _costs(home)
    yield from _stored(home)
    yield from _receivers(home)
    if (home / CATALOG).exists():
        catalog = _catalog(home)
        yield catalog
        if catalog.well:
            yield _feed(home)


def _receivers(home: Path) -> Iterator[Check]:
    """Check the declaration of the digest's receivers, if there is one."""
    if not notify_file(home).exists():
        return
    try:
        names = ", ".join(r.name for r in receivers_of(home))
    except NotifyError as error:
        yield Check("receivers", False, str(error))
    else:
        yield Check("receivers", True, f"{names or 'none'}; `hdt digest --try` sends to each")


def _costs(home: Path) -> Check:
    try:
        own = read_costs(home).filter(source=NAME_OF_COSTS).height
    except CostError as error:
        return Check("costs", False, str(error))
    message = f"{own} of the home's own" if own else f"defaults; {NAME_OF_COSTS} in the home sets yours"
    return Check("costs", True, message)


def _stored(home: Path) -> Iterator[Check]:
    """Check ledger, case log, history and tables against their seals; reads every file."""
    ledger = Ledger(home, read_only=True)
    if (home / FILE).exists() or (home / NAME).exists():
        fault = find_ledger_fault(ledger)
        yield Check("ledger", fault is None, f"it {fault}; {_NIGHT} repairs it" if fault else "ok")
    yield from _cases(home)
    if (home / "dagster").is_dir():
        fault = history.find_history_fault(home)
        yield Check("history", fault is None, f"{fault}; `hdt tidy` begins a new one" if fault else "ok")
    store, seal = Store(home.resolve()), read_seal(home)
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
    except StoreError as error:
        return Check("catalog", False, str(error))
    missing = sorted(set(views()) - {name for (name,) in present})
    return Check("catalog", not missing, f"lacks {', '.join(missing)}" if missing else f"all {len(views())} views")


_MISWRITTEN = """
select file || ': ' || string_agg(distinct coalesce(column_name || ' ', '') || replace(reason, '_', ' '), '; ')
from quarantine where reason in ('wrong_unit', 'swapped_columns', 'unit_kelvin', 'unit_kpa', 'unit_kg_s',
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
