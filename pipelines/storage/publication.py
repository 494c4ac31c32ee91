"""Publish the catalog: built under another name and renamed into place."""

import fcntl
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import duckdb

from hdt_core.tables import TABLES
from pipelines.storage.cases import CaseLog
from pipelines.storage.catalog import CATALOG, open_catalog, open_database, quote, restrict
from pipelines.storage.catalog_checks import ANOTHER_PLACE, find_form_fault
from pipelines.storage.catalog_views import (
    STORED,
    Tables,
    comment_live,
    create_views,
    fill_stored,
    set_macros,
    store_rows,
    update_files,
)
from pipelines.storage.delta import DamageError
from pipelines.storage.files import hash_of, replacing
from pipelines.storage.ledger import Ledger
from pipelines.storage.ledger_copy import copy_ledger
from pipelines.storage.naming import SCHEMA, Name, names_in, read_names
from pipelines.storage.objects import StoreError
from pipelines.storage.retention import find_night, remove_expired_daily
from pipelines.storage.seal import write_seal
from pipelines.storage.since_night import LIVE, store_since
from pipelines.storage.store import EMPTY, Store

HASH = ".catalog.hash"


def publish(home: Path) -> Path:
    """Bring `<home>/catalog.duckdb` up to date. Readers of the old file keep it; writers of it take turns.

    The last catalog's views are copied where it is whole and of this version, also in a home that was moved; only the
    files they read are new.

    Raises
    ------
    DamageError
        A file that a view reads is not what was written, and DuckDB can't open it.
    """
    store = Store(home.resolve())
    ledger = Ledger(store.home)
    tables = store.snapshot()
    nights = {"made_by": ledger.next_night(), "made_after": ledger.last_night()}
    with _turn(store.home):
        _write_catalog(store, tables, nights)
    remove_expired_daily(store, ledger)
    write_seal(store, {table: files for table, (_, files) in tables.items()})
    versions = {table: version for table, (version, _) in tables.items()}
    ledger.note_snapshot(versions, nights["made_by"])  # a snapshot implies that there is a seal
    copy_ledger(ledger)
    return store.home / CATALOG


def _write_catalog(store: Store, tables: Tables, nights: Mapping[str, str]) -> None:
    path = store.home / CATALOG
    reuse = _is_as_published(path) and find_form_fault(store.home) in (None, ANOTHER_PLACE)
    names = read_names(store)
    reuse = reuse and _names_in(store.home) == names
    sys.audit("hdt.before_publish")
    with _replacing_catalog(store, tables, from_last=reuse) as con:
        changed = update_files(con, store, tables, names) if reuse else create_views(con, store, tables, names, STORED)
        set_macros(con, nights)
        store_since(con, CaseLog(store.home))
        comment_live(con)
        store_rows(con, store, tables, {*changed, *LIVE})


def publish_lines(home: Path) -> None:
    """Bring the catalog up to date with the log of cases: the lines since the last night and what follows from them.

    A night may run meanwhile; its tables are not read. Nothing is done where the catalog has all lines, or is not as a
    night published it: the next night then makes it anew.
    """
    store = Store(home.resolve())
    log = CaseLog(store.home)
    if _log_version_in(store.home) == log.version():
        return
    with _turn(store.home):
        is_sound = _is_as_published(store.home / CATALOG) and find_form_fault(store.home) in (None, ANOTHER_PLACE)
        if not is_sound:
            return
        with _replacing_catalog(store, {}, from_last=True) as con:
            con.execute(f"set variable tables_folder = {quote(f'{store.place.url}/')}")
            store_since(con, log)
            comment_live(con)
            store_rows(con, store, {}, set(LIVE))


def _log_version_in(home: Path) -> str | None:
    """Return the version of the log of cases that the catalog has; None in one of an earlier version."""
    with open_catalog(home) as con:
        try:
            ((version,),) = con.execute("select tables.log_version()").fetchall()
        except duckdb.CatalogException:
            return None
    return str(version)


@contextmanager
def _turn(home: Path) -> Iterator[None]:
    """Let one process at a time write the catalog."""
    with open(home / ".publishing", "a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@contextmanager
def _replacing_catalog(store: Store, tables: Tables, *, from_last: bool) -> Iterator[duckdb.DuckDBPyConnection]:
    """Open the next catalog to write, a copy of the last or an empty one; at the end it replaces the last."""
    path = store.home / CATALOG
    with replacing(path) as temporary:
        if from_last:
            shutil.copyfile(path, temporary)
        con = open_database(temporary)
        try:
            store.allow_reads(con)
            con.execute("set TimeZone = 'UTC'")  # as readers have it
            con.begin()  # a commit for every comment would take longer than all the rest
            yield con
            con.commit()
        except duckdb.Error:
            for file in (file for _, files in tables.values() for file in files):
                store.tables.verify(file)  # raises for the damaged one
            raise
        finally:
            con.close()
        content_hash = hash_of(temporary.read_bytes())
        # a kill about the rename leaves one of the two in place
        _note_hashes(path.parent, [*_noted_hashes(path.parent)[-1:], content_hash])
    _note_hashes(path.parent, [content_hash])


def connect_as_of(home: Path, night: str, *, as_delivered: bool = False) -> duckdb.DuckDBPyConnection:
    """Open the catalog of an earlier night: today's views over the tables of that time.

    It is the last night that ended at or before `night`, a date or the first part of a time in UTC. Every file of it is
    checked once. Airframes are named as in `catalog.connect`.

    Raises
    ------
    StoreError
        There was no night by then, or its files have been removed.
    """
    store = Store(home.resolve())
    name, versions = find_night(Ledger(store.home, read_only=True).snapshots(), night)
    try:
        tables = store.snapshot(versions)
        for table in TABLES:  # the empty file of today has the columns that the files of that night may lack
            version, files = tables.get(table, (0, []))
            tables[table] = version, sorted({*files, f"{table}/{store.tables.shards(table)[EMPTY]}"})
        for _, files in tables.values():
            for file in files:
                store.tables.verify(file)
    except (DamageError, KeyError) as error:
        raise StoreError(f"the night of {name} is not kept whole any more: {str(error).split(';')[0]}") from None
    con = duckdb.connect(":memory:")
    store.allow_reads(con)
    names = read_names(store)
    create_views(con, store, tables, names, STORED)
    fill_stored(con)
    restrict(con, store, f"{store.place.url}/")
    if names and not as_delivered:
        con.execute(f"set schema = '{SCHEMA}'")
    return con


def _is_as_published(path: Path) -> bool:
    try:
        return hash_of(path.read_bytes()) in _noted_hashes(path.parent)
    except OSError:
        return False


def _noted_hashes(home: Path) -> list[str]:
    try:
        return (home / HASH).read_text().split()
    except (OSError, ValueError):
        return []


def _note_hashes(home: Path, hashes: Sequence[str]) -> None:
    with replacing(home / HASH) as temporary:
        temporary.write_text(" ".join(hashes))


def _names_in(home: Path) -> list[Name]:
    with open_catalog(home) as con:
        return names_in(con)
