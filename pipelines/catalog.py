"""The analysts' window: views over the Parquet files, built under another name and renamed into place."""

import re
from graphlib import TopologicalSorter
from importlib import resources
from pathlib import Path

import duckdb

from hdt_core.tables import TABLES
from pipelines.meanings import Header, declared, meaning, read_header
from pipelines.store import Store, replacing

CATALOG = "catalog.duckdb"


def publish(home: Path) -> Path:
    """Build `<home>/catalog.duckdb` anew. A reader of the old one keeps it; nobody ever meets a lock."""
    store, path = Store(home.resolve()), home.resolve() / CATALOG
    with replacing(path) as temporary:
        con = duckdb.connect(str(temporary))
        try:
            con.begin()  # a commit for every comment would take longer than all the rest
            con.execute("create schema tables")
            for table in TABLES:
                _base_view(con, store, table)
            add_views(con)
            con.commit()
        finally:
            con.close()
    return path


def add_views(con: duckdb.DuckDBPyConnection) -> None:
    """Every view, over the schema `tables`, with its question and the meaning of its columns as comments."""
    known = {name: read_header(sql) for name, sql in views().items()}
    for name, sql in ordered(views()):
        con.execute(sql)
        _comment(con, name, known)


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


def _base_view(con: duckdb.DuckDBPyConnection, store: Store, table: str) -> None:
    """`tables.<table>` over the table's files, with the declared columns even while nothing is stored."""
    empty = store.folder(table) / "empty.parquet"
    if not empty.exists():
        with replacing(empty) as temporary:
            TABLES[table].schema.create_empty().write_parquet(temporary)
    files = _quoted(store.folder(table) / "**" / "*.parquet")
    con.execute(f"create view tables.{table} as select * from read_parquet({files}, union_by_name = true)")
    add_meanings(con, table)


def add_meanings(con: duckdb.DuckDBPyConnection, table: str) -> None:
    """What each declared column of `tables.<table>` means, as its comment."""
    for column, kind in TABLES[table].schema.columns().items():
        con.execute(f"comment on column tables.{table}.{column} is {_quoted(declared(kind))}")


def _comment(con: duckdb.DuckDBPyConnection, name: str, known: dict[str, Header]) -> None:
    """The question on the view, the meaning on each of its columns."""
    con.execute(f"comment on view {name} is {_quoted(known[name].question)}")
    for column, *_ in con.execute(f"describe {name}").fetchall():
        con.execute(f'comment on column {name}."{column}" is {_quoted(meaning(name, column, known))}')


def connect(home: Path) -> duckdb.DuckDBPyConnection:
    """The published catalog, read only.

    Through it nothing but the tables' own files can be reached: no other file, no network, no extension; and no
    statement can change that.
    """
    path = home / CATALOG
    if not path.exists():
        raise FileNotFoundError(f"no catalog at {path}; run `hdt nightly --landing DIR --home {home}` first")
    con = duckdb.connect(str(path), read_only=True)
    tables = home.resolve() / "tables"
    named = con.execute("select sql from duckdb_views() where schema_name = 'tables' limit 1").fetchall()
    if named and _quoted(tables).rstrip("'") not in named[0][0]:  # the home was moved or copied, and its views were not
        con.close()
        con = duckdb.connect(str(publish(home)), read_only=True)
    ((locked,),) = con.execute("select current_setting('lock_configuration')").fetchall()  # to its end, or `sql` fails
    if not locked:  # connections of one process share one database, and who came first has locked it
        con.execute(f"set allowed_directories = [{_quoted(tables)}]")
        for setting in _LOCKS:
            con.execute(f"set {setting}")
    return con


_LOCKS = (
    "TimeZone = 'UTC'",
    "autoload_known_extensions = false",
    "autoinstall_known_extensions = false",
    "enable_external_access = false",
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
