"""The analysts' window: views over the Parquet files, built under another name and renamed into place.

The views name files by `tables.folder()`, which finds the tables beside the opened catalog: a home may be moved, copied
or mounted elsewhere and its catalog goes along unchanged.
"""

import re
import shutil
from graphlib import TopologicalSorter
from importlib import resources
from pathlib import Path

import duckdb

from hdt_core.tables import FORMER_NAMES, TABLES
from pipelines.storage import seal
from pipelines.storage.catalog import CATALOG, lock, open_catalog, quote
from pipelines.storage.data_file import hash_of
from pipelines.storage.delta import DamageError
from pipelines.storage.files import replacing
from pipelines.storage.headers import MEANINGS, meaning, read_header
from pipelines.storage.ledger import Ledger
from pipelines.storage.ledger_copy import keep_copy
from pipelines.storage.objects import StoreError
from pipelines.storage.panics import message_of
from pipelines.storage.store import EMPTY, Store
from pipelines.storage.upkeep import keep_house, night_by

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

    Raises
    ------
    DamageError
        A file that a view reads is not what was written, and DuckDB can't open it.
    """
    store, path = Store(home.resolve()), home.resolve() / CATALOG
    goes_on = _is_as_published(path) and fault_of(home) is None
    with replacing(path) as temporary:
        if goes_on:
            shutil.copyfile(path, temporary)
        held, con = store.snapshot(), duckdb.connect(str(temporary))
        try:
            store.open_to(con)
            con.begin()  # a commit for every comment would take longer than all the rest
            refill(con, held) if goes_on else fill(con, store, held)
            con.commit()
        except duckdb.Error:
            for file in (file for _, files in held.values() for file in files):
                store.tables.sound(file)  # one that is damaged says so itself
            raise
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


def connect_as_of(home: Path, night: str) -> duckdb.DuckDBPyConnection:
    """The catalog as an earlier night published it: the views of today over the tables of then.

    That is the last one that ended at or before `night`, a date or the beginning of a time in UTC. Every file that is
    named is read once, and must be what was written.

    Raises
    ------
    StoreError
        There was no night by then, or its files are not kept any more.
    """
    store = Store(home.resolve())
    name, versions = night_by(Ledger(store.home, looks=True).snapshots(), night)
    try:
        held = store.snapshot(versions)
        held |= {t: (0, [f"{t}/{store.tables.shards(t)[EMPTY]}"]) for t in TABLES if t not in versions}
        for _, files in held.values():
            for file in files:
                store.tables.sound(file)
    except (DamageError, KeyError) as error:
        raise StoreError(f"the night of {name} is not kept whole any more: {str(error).split(';')[0]}") from None
    con = duckdb.connect(":memory:")
    store.open_to(con)
    fill(con, store, held)
    lock(con, store, f"{store.place.url}/")
    return con


def _is_as_published(path: Path) -> bool:
    try:
        return hash_of(path.read_bytes()) == (path.parent / HASH).read_text()
    except (OSError, ValueError):
        return False


def fill(con: duckdb.DuckDBPyConnection, store: Store, held: dict[str, tuple[int, list[str]]]) -> None:
    """Every view, over the files that each table was made of, and a list of those files."""
    con.execute("create schema tables")
    con.execute(f"create macro tables.folder() as {_folder(store)}")
    con.execute(f"create macro tables.made_as() as {quote(_made_as(store))}")
    con.execute("create table tables.files (path varchar)")
    con.execute("comment on column tables.files.path is 'a file that the views read, below the tables'' folder'")
    refill(con, held)
    for former, table in FORMER_NAMES.items():
        con.execute(f"create view tables.{former} as from tables.{table}")
        add_meanings(con, table, former)
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
        with open_catalog(home) as con:
            ((made_as,),) = con.execute("select tables.made_as()").fetchall()
            con.execute("select max(path) from tables.files").fetchall()
            there = {v for (v,) in con.execute("select view_name from duckdb_views() where not internal").fetchall()}
    except duckdb.Error as error:
        return f"it could not be read ({message_of(error)})"
    if made_as != _made_as(Store(home.resolve())):
        return "it was made for another place or by another version"
    return "it lacked views" if {*views(), *TABLES} - there else None


def _made_as(store: Store) -> str:
    """Of what a catalog is made."""
    said = [
        f"{table}.{c} {t.schema.columns()[c].dtype} {means}"
        for table, t in TABLES.items()
        for c, means in MEANINGS[table].items()
    ]
    return hash_of("\n".join([_folder(store), *(sql for _, sql in sorted(views().items())), *said]).encode())


def _folder(store: Store) -> str:
    """Where the tables are, as an expression: objects stay, files are beside the catalog or where a variable says."""
    made = quote(f"{store.place.url}/")
    return made if store.place.remote else (_ELSEWHERE if store.url else _BESIDE).format(made=made)


def add_views(con: duckdb.DuckDBPyConnection) -> None:
    """Every view, over the schema `tables`, with its question and the meaning of its columns as comments."""
    known = {name: read_header(sql) for name, sql in views().items()}
    for _, sql in ordered(views()):
        con.execute(sql)
    told = [f"comment on view {name} is {quote(header.question)}" for name, header in known.items()]
    columns = con.execute(_COLUMNS).fetchall()
    told += [f'comment on column {v}."{c}" is {quote(meaning(v, c, known))}' for v, c in columns]
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
    named = ", ".join(map(quote, files))
    places = f"list_transform([{named}], lambda file: tables.folder() || file)"
    con.execute(f"create or replace view tables.{table} as select * from read_parquet({places}, union_by_name = true)")
    add_meanings(con, table)


def add_meanings(con: duckdb.DuckDBPyConnection, table: str, name: str | None = None) -> None:
    """Comment each column of `tables.<name>`, by default of the table's own name, with its declared meaning."""
    meanings = MEANINGS[table].items()
    con.execute("; ".join(f"comment on column tables.{name or table}.{c} is {quote(m)}" for c, m in meanings))
