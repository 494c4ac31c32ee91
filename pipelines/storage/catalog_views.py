"""Build the catalog's views over the Parquet files of the tables, and store the rows of a few of them.

The views name files by `tables.folder()`, which finds the tables beside the opened catalog, so a home may be moved,
copied or mounted elsewhere with its catalog unchanged. The rows of a few views are stored with it: a query over such a
view would be planned over two hundred Parquet readers, a second of processor before the first row.
"""

from collections.abc import Collection, Mapping, Sequence

import duckdb

from hdt_core.alerts.diagnoses import DIAGNOSES
from hdt_core.tables import TABLES
from pipelines.storage.catalog import CATALOG, quote
from pipelines.storage.files import hash_of
from pipelines.storage.naming import SCHEMA, Name, add_names, columns_of, public_view, with_present_names
from pipelines.storage.since_night import LIVE, create_live_view, live_select, prepare_since
from pipelines.storage.store import Store
from pipelines.storage.view_headers import MEANINGS, meanings_of_columns, view_headers, views

Tables = dict[str, tuple[int, list[str]]]
"""Version and files of each table, as `Store.snapshot` lists them."""
# No expression of DuckDB gives the path of a database, but its temporary files are beside the file it was opened with.
# Attached to another database, or where that setting was changed, the catalog is assumed to be where it was published.
_BESIDE_CATALOG = f"""
case
    when getvariable('tables_folder') is not null then getvariable('tables_folder')
    when ends_with(current_setting('temp_directory'), '{CATALOG}.tmp')
    then left(current_setting('temp_directory'), -{len(CATALOG) + 4}) || 'tables/'
    else {{published}}
end"""
_BY_VARIABLE = "coalesce(getvariable('tables_folder'), {published})"
STORED = (
    "flight_rates", "unobserved_units", "last_prognoses", "check_chances", "open_messages", "unit_urgencies",
    "alert_urgencies", "alert_states", "fleet_ranking", "component_ranking", "next_stop", "alert_outcomes",
    "removal_leads",
)  # fmt: skip
"""Views whose rows are stored when the catalog is published: a row a unit or alert, and none depends on the hour."""


def create_views(
    con: duckdb.DuckDBPyConnection, store: Store, tables: Tables, names: Sequence[Name], stored: Collection[str] = ()
) -> set[str]:
    """Create every view over the files of each table, and the list of those files; return the tables.

    The views of `stored` read the rows that `store_rows` stores.
    """
    con.execute("create schema tables")
    con.execute("create table tables.files (path varchar)")
    con.execute("comment on column tables.files.path is 'a file that the views read, below the tables'' folder'")
    prepare_since(con)
    changed = update_files(con, store, tables, names)
    comment_live(con)
    add_named_views(con, names, stored)
    return changed


def add_named_views(con: duckdb.DuckDBPyConnection, names: Sequence[Name], stored: Collection[str] = ()) -> None:
    """Create every view over the schema `tables`, whose rows name airframes by their present names.

    Where airframes changed their names, these views lie in the schema `airframes`, and public views over them have the
    names as delivered.
    """
    add_names(con, names)
    if names:
        con.execute(f"create schema {SCHEMA}; set schema = '{SCHEMA}'")
    add_views(con, stored)
    if names:
        columns = columns_of(con)
        con.execute("set schema = 'main'")
        for view in views():
            con.execute(public_view(view, columns[view]))
        _comment_views(con)


def list_diagnoses(con: duckdb.DuckDBPyConnection) -> None:
    """Make `tables.diagnoses()`, the codes of the diagnoses that are declared."""
    con.execute(f"create or replace macro tables.diagnoses() as {list(DIAGNOSES)}")


def update_files(con: duckdb.DuckDBPyConnection, store: Store, tables: Tables, names: Sequence[Name]) -> set[str]:
    """Update place and files, and the view of each table whose files have changed; return those."""
    con.execute(f"create or replace macro tables.folder() as {_folder(store)}")
    list_diagnoses(con)
    set_macros(con, {"made_for": hash_place(store), "made_as": hash_recipe()})
    old: dict[str, list[str]] = {}
    for (path,) in con.execute("select path from tables.files order by path").fetchall():
        old.setdefault(path.split("/")[0], []).append(path)
    con.execute("delete from tables.files")
    paths = [path for _, files in tables.values() for path in files]
    con.execute("insert into tables.files select unnest($paths)", {"paths": paths})
    changed = {table for table, (_, files) in tables.items() if files != old.get(table)}
    files_of = {table: ", ".join(map(quote, tables[table][1])) for table in sorted(changed)}
    for table, files in files_of.items():
        places = f"list_transform([{files}], lambda file: tables.folder() || file)"
        select = f"select * from read_parquet({places}, union_by_name = true, hive_partitioning = false)"
        select = create_live_view(con, table, select) if table in LIVE else select
        con.execute(f"create or replace view tables.{table} as {with_present_names(select, table, names)}")
        add_meanings(con, table)
    return changed


def set_macros(con: duckdb.DuckDBPyConnection, texts: Mapping[str, str]) -> None:
    """Make a macro without parameters of each text, by its name."""
    for name, text in texts.items():
        con.execute(f"create or replace macro tables.{name}() as {quote(text)}")


def store_rows(con: duckdb.DuckDBPyConnection, store: Store, tables: Tables, changed: set[str]) -> None:
    """Store the rows of the views of `STORED` that some table of `changed` reaches, from files that are checked.

    Files are those of `tables`; a table that it lacks is not checked.
    """
    sources = {name: header.sources for name, header in view_headers().items()}
    read = {name: _tables_below(name, sources) for name in sources if name in STORED}
    stale = [name for name in read if read[name] & changed]
    for table in sorted(set[str]().union(*(read[name] for name in stale))):
        for file in tables[table][1] if table in tables else ():
            store.tables.verify(file)
    fill_stored(con, stale)


def fill_stored(con: duckdb.DuckDBPyConnection, names: Collection[str] = STORED) -> None:
    """Store the rows of these views of `STORED` in a catalog, each after those that it reads."""
    if con.execute("from duckdb_schemas() where schema_name = $name", {"name": SCHEMA}).fetchall():
        con.execute(f"set schema = '{SCHEMA}'")
    for name, sql in views().items():
        if name in names:
            select = sql.partition(f"create or replace view {name} as")[2]
            con.execute(f"delete from tables.{name}; insert into tables.{name} {select}")
    con.execute("set schema = 'main'")


def _tables_below(view: str, sources: Mapping[str, Collection[str]]) -> set[str]:
    """List the tables that a view reads, itself or through others."""
    direct = {s.removeprefix("tables.") for s in sources[view] if s.startswith("tables.")}
    return direct.union(*(_tables_below(s, sources) for s in sources[view] if s in sources))


def hash_place(store: Store) -> str:
    """Hash the tables' place as the views name it."""
    return hash_of(_folder(store).encode())


def hash_recipe() -> str:
    """Hash all that determines a catalog but its files and place: views, columns and their meanings."""
    columns = [
        f"{table}.{name} {column.dtype} {MEANINGS[table][name]}"
        for table, t in TABLES.items()
        for name, column in t.schema.columns().items()
    ]
    texts = [*STORED, *map(live_select, LIVE), *(sql for _, sql in sorted(views().items())), *columns]
    return hash_of("\n".join(texts).encode())


def _folder(store: Store) -> str:
    """Give the tables' place as an SQL expression: a fixed URL, beside the catalog, or by the variable."""
    url = quote(f"{store.place.url}/")
    return url if store.place.remote else (_BY_VARIABLE if store.url else _BESIDE_CATALOG).format(published=url)


def add_views(con: duckdb.DuckDBPyConnection, stored: Collection[str] = ()) -> None:
    """Create every view over the schema `tables`, with its question and its columns' meanings as comments.

    Those of `stored` read a table of their name in the schema `tables`, which is made without rows.
    """
    for name, sql in views().items():
        con.execute(sql)
        if name in stored:
            con.execute(f"create table tables.{name} as from {name} limit 0")
            con.execute(f"create or replace view {name} as from tables.{name}")
    _comment_views(con, stored)


def _comment_views(con: duckdb.DuckDBPyConnection, stored: Collection[str] = ()) -> None:
    """Comment the views of the current schema, and tables of their names that are `stored`."""
    questions = {name: header.question for name, header in view_headers().items()}
    con.execute("; ".join(f"comment on view {name} is {quote(question)}" for name, question in questions.items()))
    meanings = meanings_of_columns()
    for view, columns in columns_of(con).items():
        for place in (view, f"tables.{view}") if view in stored else (view,):
            _comment(con, place, {c: meanings[view].get(c, "") for c in columns})


def comment_live(con: duckdb.DuckDBPyConnection) -> None:
    """Comment the parts that the tables of `LIVE` are made of."""
    for table in LIVE:
        for part in (f"{table}_of_night", f"{table}_since"):
            _comment(con, f"tables.{part}", MEANINGS[table])


def add_meanings(con: duckdb.DuckDBPyConnection, table: str) -> None:
    """Comment each column of `tables.<table>` with its declared meaning."""
    _comment(con, f"tables.{table}", MEANINGS[table])


def _comment(con: duckdb.DuckDBPyConnection, place: str, meanings: Mapping[str, str]) -> None:
    """Comment columns of a table or view, all at once: half the time."""
    texts = {c: meaning.replace("'", "''") for c, meaning in meanings.items()}
    con.execute("; ".join(f"comment on column {place}.\"{c}\" is '{text}'" for c, text in texts.items()))
