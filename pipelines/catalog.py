"""The analysts' window: views over the Parquet files, built under another name and renamed into place."""

import re
from graphlib import TopologicalSorter
from importlib import resources
from pathlib import Path

import duckdb

from hdt_core.tables import TABLES
from pipelines.files import replacing
from pipelines.meanings import Header, declared, meaning, read_header
from pipelines.objects import StoreError
from pipelines.store import URL, Store

CATALOG = "catalog.duckdb"


def publish(home: Path) -> Path:
    """Build `<home>/catalog.duckdb` anew. A reader of the old one keeps it; nobody ever meets a lock."""
    store, path = Store(home.resolve()), home.resolve() / CATALOG
    for table in TABLES:
        store.declare(table)
    with replacing(path) as temporary:
        con = duckdb.connect(str(temporary))
        try:
            store.open_to(con)
            con.begin()  # a commit for every comment would take longer than all the rest
            con.execute("create schema tables")
            for table, sources in store.snapshot().items():
                _base_view(con, table, sources)
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


def _base_view(con: duckdb.DuckDBPyConnection, table: str, sources: list[str]) -> None:
    """`tables.<table>` over the table's files or objects."""
    named = ", ".join(_quoted(source) for source in sources)
    con.execute(f"create view tables.{table} as select * from read_parquet([{named}], union_by_name = true)")
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

    Through it nothing but the tables' own files or objects can be reached: no other file, no other place in the
    network, no extension; and no statement can change that.

    Raises
    ------
    FileNotFoundError
        Nothing has been published yet.
    StoreError
        What was published reads another store than HDT_STORE_URL names.
    """
    if not (home / CATALOG).exists():
        raise FileNotFoundError(f"no catalog at {home / CATALOG}; run `hdt nightly --landing DIR --home {home}` first")
    store, con = Store(home.resolve()), _opened(home)
    named = con.execute("select sql from duckdb_views() where schema_name = 'tables' limit 1").fetchall()
    if (
        named and _quoted(f"{store.root}/").rstrip("'") not in named[0][0]
    ):  # the home was moved or copied, its views were not
        con.close()
        if "'s3://" in named[0][0] or store.remote:
            raise StoreError(f"the catalog in {home} reads another store than {store.root}; set {URL} as it was")
        publish(home)
        con = _opened(home)
    ((locked,),) = con.execute("select current_setting('lock_configuration')").fetchall()  # to its end, or `sql` fails
    if not locked:  # connections of one process share one database, and who came first has locked it
        store.open_to(con)
        con.execute(f"set allowed_directories = [{_quoted(store.root)}]")
        for setting in _LOCKS:
            con.execute(f"set {setting}")
    return con


def _opened(home: Path) -> duckdb.DuckDBPyConnection:
    return duckdb.connect(str(home / CATALOG), read_only=True)


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
