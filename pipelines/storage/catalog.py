"""Open the catalog read only, with access to the tables' own files and nothing else."""

import atexit
import re
import shutil
import sqlite3
import tempfile
import threading
import time
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Self, cast

import duckdb

from hdt_core.tables import TABLES
from pipelines.storage.database import DatabaseError
from pipelines.storage.ledger import Ledger, night_number
from pipelines.storage.objects import StoreError, message_of
from pipelines.storage.store import URL, Store

CATALOG = "catalog.duckdb"
OLDEST_READER = "v1.0.0"
_TRUST_S = 3600.0
_OPENING = threading.Lock()


def open_database(path: Path) -> duckdb.DuckDBPyConnection:
    """Open a DuckDB file to write, in the format that every DuckDB since 1.0 reads."""
    return duckdb.connect(str(path), config={"storage_compatibility_version": OLDEST_READER})


def catalog_version(home: Path) -> tuple[int, int]:
    """Return what differs between two publications of the catalog; raise `OSError` where there is none."""
    stat = (home / CATALOG).stat()
    return stat.st_ino, stat.st_ctime_ns


def connect(home: Path, *, as_delivered: bool = False) -> duckdb.DuckDBPyConnection:
    """Open the published catalog read only: nothing in the home is written, not even what a large sort spills.

    Its views name airframes by their present operator and tail, so that they join; `as_delivered` as public views do.

    The connection reaches nothing but the tables' own files or objects: no other file, no other place in the network,
    no extension; and no statement can change that.

    Raises
    ------
    FileNotFoundError
        Nothing has been published yet.
    StoreError
        It is damaged or of another version, or reads another store than HDT_STORE_URL names.
    """
    if not (home / CATALOG).exists():
        raise FileNotFoundError(f"no catalog at {home / CATALOG}; run `hdt nightly --landing DIR --home {home}` first")
    with _OPENING:  # connections of one process share a database: of two first ones at once, one may lock it
        con = _open_locked(home)
    if not as_delivered and con.execute("from duckdb_schemas() where schema_name = 'airframes'").fetchall():
        con.execute("set schema = 'airframes'")
    return cast("duckdb.DuckDBPyConnection", _VerifiedCatalog(con, home))


def _open_locked(home: Path) -> duckdb.DuckDBPyConnection:
    """Connect to the catalog with access to the tables' place alone."""
    version = _version_or_none(home)
    try:
        con = open_catalog(home)
        ((is_restricted, published_folder),) = con.execute(
            "select current_setting('lock_configuration'), tables.folder()"
        ).fetchall()
        con.execute("select max(path) from tables.files")
    except duckdb.Error as error:
        raise StoreError(
            f"the catalog in {home} can't be read ({message_of(error)}); `hdt nightly` makes it anew"
        ) from None
    if not _is_of_last_night(con, home):
        con.close()
        if _version_or_none(home) != version:  # published meanwhile
            return _open_locked(home)
        raise StoreError(f"the catalog in {home} is not that of the last night; `hdt nightly` publishes it again")
    folder = _allowed_folder(con) if is_restricted else restrict(con, Store(home.resolve()), published_folder)
    con.execute(f"set variable tables_folder = {quote(folder)}")  # each connection has variables of its own
    return con


def _is_of_last_night(con: duckdb.DuckDBPyConnection, home: Path) -> bool:
    """Return whether the catalog is that of the last night on record, or of one that is about to be recorded."""
    try:
        last = Ledger(home, read_only=True).last_night()
    except (sqlite3.Error, DatabaseError):  # of which the doctor tells
        return True
    return not night_number(last) or last in nights_of(con)  # earlier versions have no numbers, and name none


def nights_of(con: duckdb.DuckDBPyConnection) -> tuple[str, str]:
    """Return the names of the night that made a catalog and of the one before; empty in those of earlier versions."""
    try:
        ((night, before),) = con.execute("select tables.made_by(), tables.made_after()").fetchall()
    except duckdb.CatalogException:
        return "", ""
    return night, before


class _VerifiedCatalog:
    """A connection that checks the files' hashes before it answers: DuckDB checks no checksum of Parquet.

    Before a statement is run, the files of each table that it may read through the views it names are checked: once in
    a process and an hour.
    """

    def __init__(self, con: duckdb.DuckDBPyConnection, home: Path) -> None:
        self._con, self._tables = con, Store(home.resolve()).tables
        version = _version_or_none(home)
        self._verified = _verified_tables(version, int(time.time() / _TRUST_S))
        self._views = _names_by_view(version)
        if not self._views:
            sql = con.execute(
                "select view_name, sql from duckdb_views() where schema_name <> 'tables' and not internal"
            )
            for name, text in sql.fetchall():
                self._views.setdefault(str(name), set()).update(_names(text))

    def sql(self, query: str, **how: Any) -> duckdb.DuckDBPyRelation:
        """Run a select."""
        self._verify(query)
        return self._con.sql(query, **how)

    def execute(self, query: str, *values: Any) -> duckdb.DuckDBPyConnection:
        """Run a statement."""
        self._verify(query)
        return self._con.execute(query, *values)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._con, name)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._con.close()

    def _verify(self, query: str) -> None:
        """Raise where a file that a statement may read is damaged."""
        names = set[str]()
        more = _names(query)
        while more:
            names |= more
            more = set[str]().union(*(self._views[name] for name in more & self._views.keys())) - names
        tables = TABLES.keys() if names & _ANY_FILE else names & TABLES.keys()
        for table in sorted(tables - self._verified):
            query_files = "select path from tables.files where starts_with(path, $prefix)"
            for (path,) in self._con.execute(query_files, {"prefix": f"{table}/"}).fetchall():
                self._tables.verify(path)
            self._verified.add(table)


_ANY_FILE = {"query", "query_table", "glob", "parquet", "read_parquet", "parquet_scan"}
"""Names with which a statement may read a table that it does not name."""


def _names(sql: str) -> set[str]:
    return set(re.findall(r"\w+", sql.lower()))


@lru_cache(maxsize=4)
def _verified_tables(_catalog: tuple[int, int] | None, _hour: int) -> set[str]:
    """Cache of a catalog's tables whose files this process has checked within the hour."""
    return set()


@lru_cache(maxsize=4)
def _names_by_view(_catalog: tuple[int, int] | None) -> dict[str, set[str]]:
    """Cache of the names in the SQL of a catalog's views."""
    return {}


def open_catalog(home: Path) -> duckdb.DuckDBPyConnection:
    """Open the catalog read only; again where it was replaced meanwhile, since DuckDB opens it three times by name."""
    path = home / CATALOG
    for _ in range(9):
        before = _version_or_none(home)
        try:
            con = duckdb.connect(str(path), read_only=True)
        except duckdb.Error:
            if _version_or_none(home) == before:
                raise
            continue
        if _version_or_none(home) == before:
            return con
        con.close()
    raise duckdb.IOException(f"{path} was replaced nine times while it was opened")


def _version_or_none(home: Path) -> tuple[int, int] | None:
    try:
        return catalog_version(home)
    except FileNotFoundError:
        return None


def restrict(con: duckdb.DuckDBPyConnection, store: Store, published_folder: str) -> str:
    """Restrict a connection to the store's place, which is returned."""
    remote = published_folder.startswith("s3://")
    if store.place.remote != remote or (remote and published_folder != f"{store.place.url}/"):
        con.close()
        raise StoreError(f"the catalog in {store.home} reads another store than {store.place.url}; set {URL} as it was")
    folder = f"{store.place.url}/" if store.url else published_folder
    store.allow_reads(con)
    con.execute(f"set allowed_directories = [{quote(folder)}]")
    con.execute(f"set temp_directory = {quote(_scratch())}")
    for setting in _LOCKS:
        con.execute(f"set {setting}")
    return folder


def _allowed_folder(con: duckdb.DuckDBPyConnection) -> str:
    """Find the place that `restrict` left open; DuckDB adds that of its temporary files."""
    folders = "select unnest(current_setting('allowed_directories')), current_setting('temp_directory')"
    return next(str(place) for place, scratch in con.execute(folders).fetchall() if place.rstrip("/") != scratch)


@cache
def _scratch() -> str:
    """Make this process's folder for what does not fit into memory; it is removed at exit."""
    folder = tempfile.mkdtemp(prefix="hdt-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


_LOCKS = (
    "TimeZone = 'UTC'",
    "autoload_known_extensions = false",
    "autoinstall_known_extensions = false",
    "enable_external_access = false",
    "enable_progress_bar = false",  # a bar on stderr is no answer
    "lock_configuration = true",
)


def run_select(con: duckdb.DuckDBPyConnection, sql: str) -> duckdb.DuckDBPyRelation | None:
    """Run one select.

    Raises
    ------
    ValueError
        `sql` is anything else: a read-only DuckDB would still run `copy ... to` and write a file among the tables.
    """
    kinds = [str(s.type).rpartition(".")[2] for s in con.extract_statements(sql)]
    if kinds != ["SELECT"]:
        raise ValueError(f"a single select is answered, and this is {' and '.join(kinds) or 'nothing'}")
    return con.sql(sql)


def fetch_dicts(result: duckdb.DuckDBPyConnection) -> list[dict[str, Any]]:
    """Fetch the rows of a result as dicts by column name."""
    names = [c[0] for c in result.description or ()]
    return [dict(zip(names, row, strict=True)) for row in result.fetchall()]


def quote(value: Path | str) -> str:
    """Quote a text as an SQL literal."""
    return "'" + str(value).replace("'", "''") + "'"
