"""The analysts' window: views over the Parquet files, built under another name and renamed into place.

The views name files by `tables.folder()`, which finds the tables beside the opened catalog: a home may be moved, copied
or mounted elsewhere and its catalog goes along unchanged.
"""

import atexit
import re
import shutil
import tempfile
from functools import cache
from graphlib import TopologicalSorter
from importlib import resources
from pathlib import Path

import duckdb

from hdt_core.tables import TABLES
from pipelines.storage import seal
from pipelines.storage.delta import hash_of
from pipelines.storage.files import replacing
from pipelines.storage.headers import MEANINGS, meanings, read_header
from pipelines.storage.ledger import Ledger
from pipelines.storage.ledger_copy import keep_copy
from pipelines.storage.objects import StoreError
from pipelines.storage.store import URL, Store
from pipelines.storage.upkeep import keep_house

CATALOG = "catalog.duckdb"
HASH = ".catalog.hash"
# DuckDB tells no expression where a database lies, but keeps its own temporary files beside the file it was opened
# with. Attached to another database, or where that setting was changed, the catalog is taken to be where it was made.
_BESIDE = f"""
case
    when getvariable('tables_folder') is not null then getvariable('tables_folder')
    when ends_with(current_setting('temp_directory'), '{CATALOG}.tmp')
    then left(current_setting('temp_directory'), -{len(CATALOG) + 4}) || 'tables/'
    else {{made}}
end"""
_ELSEWHERE = "coalesce(getvariable('tables_folder'), {made})"


def publish(home: Path) -> Path:
    """Bring `<home>/catalog.duckdb` up to date. A reader of the old one keeps it; nobody ever meets a lock.

    The views are those of the last one where that is whole and of this version; only what they read is new.
    """
    store, path = Store(home.resolve()), home.resolve() / CATALOG
    goes_on = _is_as_published(path) and fault_of(home) is None
    with replacing(path) as temporary:
        if goes_on:
            shutil.copyfile(path, temporary)
        con = duckdb.connect(str(temporary))
        try:
            store.open_to(con)
            con.begin()  # a commit for every comment would take longer than all the rest
            held = store.snapshot()
            refill(con, held) if goes_on else fill(con, store, held)
            con.commit()
        finally:
            con.close()
        published = hash_of(temporary.read_bytes())
    (path.parent / HASH).write_text(published)  # where a kill comes first, the next one is built anew
    ledger = Ledger(store.home)
    keep_house(store, ledger)
    seal.seal(store, {table: files for table, (_, files) in held.items()})
    ledger.note_snapshot({table: version for table, (version, _) in held.items()})  # after the seal: it is missed then
    keep_copy(ledger)
    return path


def _is_as_published(path: Path) -> bool:
    try:
        return hash_of(path.read_bytes()) == (path.parent / HASH).read_text()
    except (OSError, ValueError):
        return False


def fill(con: duckdb.DuckDBPyConnection, store: Store, held: dict[str, tuple[int, list[str]]]) -> None:
    """Every view, over the files that each table was made of, and a list of those files."""
    con.execute("create schema tables")
    con.execute(f"create macro tables.folder() as {_folder(store)}")
    con.execute(f"create macro tables.made_as() as {_quoted(_made_as(store))}")
    con.execute("create table tables.files (path varchar)")
    con.execute("comment on column tables.files.path is 'a file that the views read, below the tables'' folder'")
    refill(con, held)
    add_views(con)


def refill(con: duckdb.DuckDBPyConnection, held: dict[str, tuple[int, list[str]]]) -> None:
    """The list of files, and the view of each table whose files are others than those listed."""
    listed: dict[str, list[str]] = {}
    for (path,) in con.execute("select path from tables.files order by path").fetchall():
        listed.setdefault(path.split("/")[0], []).append(path)
    con.execute("delete from tables.files")
    paths = [path for _, files in held.values() for path in files]
    con.execute("insert into tables.files select unnest($paths)", {"paths": paths})
    for table, (_, files) in held.items():
        if files != listed.get(table):
            _base_view(con, table, files)


def fault_of(home: Path) -> str | None:
    """Why the catalog must be made anew; None where it is whole, of this version and reads this home's tables."""
    if not (home / CATALOG).exists():
        return "it was missing"
    try:
        with _opened(home) as con:
            ((made_as,),) = con.execute("select tables.made_as()").fetchall()
            con.execute("select max(path) from tables.files").fetchall()
            there = {v for (v,) in con.execute("select view_name from duckdb_views() where not internal").fetchall()}
    except duckdb.Error as error:
        return f"it could not be read ({_first_line(error)})"
    if made_as != _made_as(Store(home.resolve())):
        return "it was made for another place or by another version"
    return "it lacked views" if {*views(), *TABLES} - there else None


def _made_as(store: Store) -> str:
    """Of what a catalog is made."""
    said = [f"{table}.{c} {means}" for table, columns in MEANINGS.items() for c, means in columns.items()]
    return hash_of("\n".join([_folder(store), *(sql for _, sql in sorted(views().items())), *said]).encode())


def _folder(store: Store) -> str:
    """Where the tables are, as an expression: objects stay, files are beside the catalog or where a variable says."""
    made = _quoted(f"{store.root}/")
    return made if store.remote else (_ELSEWHERE if store.url else _BESIDE).format(made=made)


def add_views(con: duckdb.DuckDBPyConnection) -> None:
    """Every view, over the schema `tables`, with its question and the meaning of its columns as comments."""
    known = {name: read_header(sql) for name, sql in views().items()}
    for _, sql in ordered(views()):
        con.execute(sql)
    columns: dict[str, list[str]] = {}
    for view, column in con.execute(_COLUMNS).fetchall():
        columns.setdefault(view, []).append(column)
    told = [f"comment on view {name} is {_quoted(header.question)}" for name, header in known.items()]
    told += [f'comment on column {v}."{c}" is {_quoted(m)}' for (v, c), m in meanings(columns, known).items()]
    con.execute("; ".join(told))  # at once: half the time


_COLUMNS = """
select table_name, column_name from duckdb_columns()
where database_name = current_database() and schema_name = 'main' and not internal
order by table_name, column_index"""


def views() -> dict[str, str]:
    """SQL of every view, by name: the file's name is the view's."""
    folder = resources.files("sql") / "views"
    return {f.name.removesuffix(".sql"): f.read_text() for f in folder.iterdir() if f.name.endswith(".sql")}


def ordered(sql: dict[str, str]) -> list[tuple[str, str]]:
    """Views in an order in which each finds what it reads; the header's `Reads:` says what that is."""
    reads = {name: set(read_header(text).reads) & set(sql) for name, text in sql.items()}
    return [(name, sql[name]) for name in TopologicalSorter(reads).static_order()]


def tables_read() -> list[str]:
    """Tables that some view reads: what a catalog needs to answer every question."""
    read = {t for sql in views().values() for t in re.findall(r"\btables\.(\w+)", sql)}
    return [t for t in TABLES if t in read]


def _base_view(con: duckdb.DuckDBPyConnection, table: str, files: list[str]) -> None:
    """`tables.<table>` over the files that it was when the catalog was made, below `tables.folder()`."""
    named = ", ".join(map(_quoted, files))
    places = f"list_transform([{named}], lambda file: tables.folder() || file)"
    con.execute(f"create or replace view tables.{table} as select * from read_parquet({places}, union_by_name = true)")
    add_meanings(con, table)


def add_meanings(con: duckdb.DuckDBPyConnection, table: str) -> None:
    """What each declared column of `tables.<table>` means, as its comment."""
    told = (f"comment on column tables.{table}.{c} is {_quoted(m)}" for c, m in MEANINGS[table].items())
    con.execute("; ".join(told))


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
        con = _opened(home)
        ((locked, made),) = con.execute("select current_setting('lock_configuration'), tables.folder()").fetchall()
        files = [path for (path,) in con.execute("select path from tables.files").fetchall()]
    except duckdb.Error as error:
        raise StoreError(
            f"the catalog in {home} can't be read ({_first_line(error)}); `hdt nightly` makes it anew"
        ) from None
    # connections of one process share one database, and who came first has locked it; each has variables of its own
    folder = _held(con) if locked else lock(con, Store(home.resolve()), made)
    con.execute(f"set variable tables_folder = {_quoted(folder)}")
    _verify(con, home, files)
    return con


def _verify(con: duckdb.DuckDBPyConnection, home: Path, files: list[str]) -> None:
    """Raise where a file that the views read is not what was written."""
    store = Store(home.resolve())
    if not store.remote and (lost := seal.changed(store, seal.read(store.home), files)):
        con.close()
        raise StoreError(f"{seal.named(lost)} missing or not what was written; `hdt nightly` makes it again")


def _opened(home: Path) -> duckdb.DuckDBPyConnection:
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
    con.execute(f"set allowed_directories = [{_quoted(folder)}]")
    con.execute(f"set temp_directory = {_quoted(_scratch())}")
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


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0]


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


def _quoted(value: Path | str) -> str:
    return "'" + str(value).replace("'", "''") + "'"
