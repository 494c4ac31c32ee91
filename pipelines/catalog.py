"""The analysts' window: views over the Parquet files, built under another name and renamed into place."""

import re
from graphlib import TopologicalSorter
from importlib import resources
from pathlib import Path

import duckdb

from hdt_core.tables import TABLES
from pipelines.store import Store, replacing

CATALOG = "catalog.duckdb"
_READS = re.compile(r"Reads:\s*([a-z0-9_, \n-]+?)\.", re.IGNORECASE)


def publish(home: Path) -> Path:
    """Build `<home>/catalog.duckdb` anew. A reader of the old one keeps it; nobody ever meets a lock."""
    store, path = Store(home.resolve()), home.resolve() / CATALOG
    with replacing(path) as temporary:
        con = duckdb.connect(str(temporary))
        try:
            con.execute("create schema tables")
            for table in TABLES:
                _base_view(con, store, table)
            for name, sql in ordered(views()):
                con.execute(sql)
                _comment(con, name)
        finally:
            con.close()
    return path


def views() -> dict[str, str]:
    """SQL of every view, by name: the file's name is the view's."""
    folder = resources.files("sql") / "views"
    return {f.name.removesuffix(".sql"): f.read_text() for f in folder.iterdir() if f.name.endswith(".sql")}


def ordered(sql: dict[str, str]) -> list[tuple[str, str]]:
    """Views in an order in which each finds what it reads; the header's `Reads:` says what that is."""
    reads = {
        name: {w for w in re.findall(r"[a-z_0-9]+", _header(text)) if w in sql} - {name} for name, text in sql.items()
    }
    return [(name, sql[name]) for name in TopologicalSorter(reads).static_order()]


def _header(sql: str) -> str:
    comment = " ".join(line.removeprefix("--").strip() for line in sql.splitlines() if line.startswith("--"))
    found = _READS.search(comment)
    return found.group(1) if found else ""


def _base_view(con: duckdb.DuckDBPyConnection, store: Store, table: str) -> None:
    """`tables.<table>` over the table's files, with the declared columns even while nothing is stored."""
    empty = store.folder(table) / "empty.parquet"
    if not empty.exists():
        with replacing(empty) as temporary:
            TABLES[table].schema.create_empty().write_parquet(temporary)
    files = _quoted(store.folder(table) / "**" / "*.parquet")
    con.execute(f"create view tables.{table} as select * from read_parquet({files}, union_by_name = true)")
    for column, declared in TABLES[table].schema.columns().items():
        if declared.metadata:
            meaning = f"{declared.metadata['meaning']} [{declared.metadata['unit'] or 'text'}]".replace("'", "''")
            con.execute(f"comment on column tables.{table}.{column} is '{meaning}'")


def _comment(con: duckdb.DuckDBPyConnection, name: str) -> None:
    question = next(
        (line.removeprefix("--").strip() for line in views()[name].splitlines() if line.startswith("--")), ""
    )
    con.execute(f"""comment on view {name} is '{question.replace("'", "''")}'""")


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
    named = con.execute("select sql from duckdb_views() where schema_name = 'tables' limit 1").fetchone()
    if named and _quoted(tables).rstrip("'") not in named[0]:  # the home was moved or copied, and its views were not
        con.close()
        con = duckdb.connect(str(publish(home)), read_only=True)
    (locked,) = con.execute("select current_setting('lock_configuration')").fetchone() or (False,)
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


def _quoted(path: Path) -> str:
    return "'" + str(path).replace("'", "''") + "'"
