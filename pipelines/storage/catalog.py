"""The catalog as it is opened: read only, and with no way out of it but to the tables' own files."""

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path

import duckdb

from pipelines.storage import seal
from pipelines.storage.objects import StoreError
from pipelines.storage.panics import message_of
from pipelines.storage.store import URL, Store

CATALOG = "catalog.duckdb"


def connect(home: Path) -> duckdb.DuckDBPyConnection:
    """The published catalog, read only: nothing in the home is written, not even what a large sort spills.

    Through it nothing but the tables' own files or objects can be reached: no other file, no other place in the
    network, no extension; and no statement can change that.

    Raises
    ------
    FileNotFoundError
        Nothing has been published yet.
    StoreError
        It is damaged or of another version, or reads another store than HDT_STORE_URL names.
    """
    if not (home / CATALOG).exists():
        raise FileNotFoundError(f"no catalog at {home / CATALOG}; run `hdt nightly --landing DIR --home {home}` first")
    try:
        con = open_catalog(home)
        ((locked, made),) = con.execute("select current_setting('lock_configuration'), tables.folder()").fetchall()
        files = [path for (path,) in con.execute("select path from tables.files").fetchall()]
    except duckdb.Error as error:
        raise StoreError(
            f"the catalog in {home} can't be read ({message_of(error)}); `hdt nightly` makes it anew"
        ) from None
    # connections of one process share one database, and who came first has locked it; each has variables of its own
    folder = _held(con) if locked else lock(con, Store(home.resolve()), made)
    con.execute(f"set variable tables_folder = {quote(folder)}")
    _verify(con, home, files)
    return con


def _verify(con: duckdb.DuckDBPyConnection, home: Path, files: list[str]) -> None:
    """Raise where a file that the views read is not what was written."""
    store = Store(home.resolve())
    if not store.remote and (lost := seal.changed(store, seal.read(store.home), files)):
        con.close()
        raise StoreError(f"{seal.named(lost)} missing or not what was written; `hdt nightly` makes it again")


def open_catalog(home: Path) -> duckdb.DuckDBPyConnection:
    """Read only. DuckDB opens a file three times by name: one that was replaced in between is opened once more."""
    path = home / CATALOG
    for _ in range(9):
        before = _identity(path)
        try:
            con = duckdb.connect(str(path), read_only=True)
        except duckdb.Error:
            if _identity(path) == before:
                raise
            continue
        if _identity(path) == before:
            return con
        con.close()
    raise duckdb.IOException(f"{path} was replaced nine times while it was opened")


def _identity(path: Path) -> tuple[int, int] | None:
    """Which file stands there: another one after each publication."""
    try:
        told = path.stat()
    except FileNotFoundError:
        return None
    return told.st_ino, told.st_mtime_ns


def lock(con: duckdb.DuckDBPyConnection, store: Store, made: str) -> str:
    """Leave open the store's place and nothing else; that place."""
    if store.remote != made.startswith("s3://") or (store.remote and made != f"{store.root}/"):
        con.close()
        raise StoreError(f"the catalog in {store.home} reads another store than {store.root}; set {URL} as it was")
    folder = f"{store.root}/" if store.url else made
    store.open_to(con)
    con.execute(f"set allowed_directories = [{quote(folder)}]")
    con.execute(f"set temp_directory = {quote(_scratch())}")
    for setting in _LOCKS:
        con.execute(f"set {setting}")
    return folder


def _held(con: duckdb.DuckDBPyConnection) -> str:
    """The place that `lock` left open; DuckDB adds that of its temporary files."""
    open_to = "select unnest(current_setting('allowed_directories')), current_setting('temp_directory')"
    return next(str(place) for place, scratch in con.execute(open_to).fetchall() if place.rstrip("/") != scratch)


@cache
def _scratch() -> str:
    """This process's own folder for what does not fit into memory; gone when it ends."""
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


def ask(con: duckdb.DuckDBPyConnection, sql: str) -> duckdb.DuckDBPyRelation | None:
    """The answer to one select.

    Raises
    ------
    ValueError
        `sql` is anything else: a read-only DuckDB would still run `copy ... to` and write a file among the tables.
    """
    asked = con.extract_statements(sql)
    kinds = [str(s.type).rpartition(".")[2] for s in asked]
    if kinds != ["SELECT"]:
        raise ValueError(f"a single select is answered, and this is {' and '.join(kinds) or 'nothing'}")
    return con.sql(sql)


def quote(value: Path | str) -> str:
    """A text as SQL takes it."""
    return "'" + str(value).replace("'", "''") + "'"
