"""Publish the catalog: views over the Parquet files, built under another name and renamed into place.

The views name files by `tables.folder()`, which finds the tables beside the opened catalog, so a home may be moved,
copied or mounted elsewhere with its catalog unchanged. The rows of a few views are stored with it: a query over such a
view would be planned over two hundred Parquet readers, a second of processor before the first row.
"""

import fcntl
import shutil
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import duckdb

from hdt_core.alerts.diagnoses import DIAGNOSES
from hdt_core.tables import TABLES
from pipelines.storage.cases import CaseLog
from pipelines.storage.catalog import CATALOG, connect, nights_of, open_catalog, open_database, quote, restrict
from pipelines.storage.delta import DamageError
from pipelines.storage.files import hash_of, replacing
from pipelines.storage.ledger import Ledger
from pipelines.storage.naming import (
    SCHEMA,
    Name,
    add_names,
    columns_of,
    names_in,
    public_view,
    read_names,
    with_present_names,
)
from pipelines.storage.objects import StoreError, message_of
from pipelines.storage.seal import copy_ledger, find_night, remove_expired_daily, write_seal
from pipelines.storage.since_night import LIVE, create_live_view, live_select, prepare_since, store_since
from pipelines.storage.store import EMPTY, Store
from pipelines.storage.view_headers import MEANINGS, meanings_of_columns, view_headers, views

HASH = ".catalog.hash"
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
STORED = (
    "flight_rates", "unobserved_units", "last_prognoses", "check_chances", "unit_urgencies", "alert_urgencies",
    "alert_states", "fleet_ranking", "component_ranking", "next_stop", "alert_outcomes", "removal_leads",
)  # fmt: skip
"""Views whose rows are stored when the catalog is published: a row a unit or alert, and none depends on the hour."""
_ANOTHER_PLACE = "it was made for another place"
_BY_VARIABLE = "coalesce(getvariable('tables_folder'), {published})"


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
    reuse = _is_as_published(path) and _find_form_fault(store.home) in (None, _ANOTHER_PLACE)
    names = read_names(store)
    reuse = reuse and _names_in(store.home) == names
    sys.audit("hdt.before_publish")
    with _replacing_catalog(store, tables, from_last=reuse) as con:
        changed = update_files(con, store, tables, names) if reuse else create_views(con, store, tables, names, STORED)
        _set_macros(con, nights)
        store_since(con, CaseLog(store.home))
        _comment_live(con)
        _store_rows(con, store, tables, {*changed, *LIVE})


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
        is_sound = _is_as_published(store.home / CATALOG) and _find_form_fault(store.home) in (None, _ANOTHER_PLACE)
        if not is_sound:
            return
        with _replacing_catalog(store, {}, from_last=True) as con:
            con.execute(f"set variable tables_folder = {quote(f'{store.place.url}/')}")
            store_since(con, log)
            _comment_live(con)
            _store_rows(con, store, {}, set(LIVE))


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


def create_views(
    con: duckdb.DuckDBPyConnection, store: Store, tables: Tables, names: Sequence[Name], stored: Collection[str] = ()
) -> set[str]:
    """Create every view over the files of each table, and the list of those files; return the tables.

    The views of `stored` read the rows that `_store_rows` stores.
    """
    con.execute("create schema tables")
    con.execute("create table tables.files (path varchar)")
    con.execute("comment on column tables.files.path is 'a file that the views read, below the tables'' folder'")
    prepare_since(con)
    changed = update_files(con, store, tables, names)
    _comment_live(con)
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
    _set_macros(con, {"made_for": _place_hash(store), "made_as": _recipe_hash()})
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


def _set_macros(con: duckdb.DuckDBPyConnection, texts: Mapping[str, str]) -> None:
    for name, text in texts.items():
        con.execute(f"create or replace macro tables.{name}() as {quote(text)}")


def _store_rows(con: duckdb.DuckDBPyConnection, store: Store, tables: Tables, changed: set[str]) -> None:
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


def connect_current(home: Path) -> duckdb.DuckDBPyConnection:
    """Open the catalog as `catalog.connect` does, for readers of views that differ between versions.

    Raises
    ------
    FileNotFoundError, StoreError
        As of `catalog.connect`; or another version published it.
    """
    con = connect(home)
    ((recipe_hash,),) = con.execute("select tables.made_as()").fetchall()
    if recipe_hash != _recipe_hash():
        con.close()
        raise StoreError(f"the catalog in {home} was published by another version; `hdt nightly` publishes it again")
    return con


def find_catalog_fault(home: Path) -> str | None:
    """Check the catalog; the fault in words, None where it is whole, of this version and of this home's tables now."""
    return _find_form_fault(home) or find_staleness(home)


def find_staleness(home: Path) -> str | None:
    """Compare the catalog with the ledger and the tables; in words why it is not theirs, None where it is."""
    ledger = Ledger(home, read_only=True)
    store = Store(home.resolve())
    with open_catalog(home) as con:
        night = nights_of(con)[0]
        files = {path for (path,) in con.execute("select path from tables.files").fetchall()}
    if not night or night != ledger.last_night():
        return "it was not that of the last night"
    published = ledger.snapshots()[night]
    changed_tables = [table for table in TABLES if store.tables.newest_version(table) != published.get(table)]
    current = {f"{table}/{file}" for table in changed_tables for file in store.tables.shards(table).values()}
    of_moved = {path for path in files if path.split("/")[0] in changed_tables}
    return None if current == of_moved else "it was older than the tables"  # a vacuum moves a version and no file


def _find_form_fault(home: Path) -> str | None:
    if not (home / CATALOG).exists():
        return "it was missing"
    try:
        with open_catalog(home) as con:
            ((recipe_hash, place_hash),) = con.execute("select tables.made_as(), tables.made_for()").fetchall()
            con.execute("select max(path) from tables.files").fetchall()
            present = {v for (v,) in con.execute("select view_name from duckdb_views() where not internal").fetchall()}
    except duckdb.Error as error:
        return f"it could not be read ({message_of(error)})"
    if recipe_hash != _recipe_hash():
        return "it was made by another version"
    if {*views(), *TABLES} - present:
        return "it lacked views"
    return None if place_hash == _place_hash(Store(home.resolve())) else _ANOTHER_PLACE


def _place_hash(store: Store) -> str:
    return hash_of(_folder(store).encode())


def _recipe_hash() -> str:
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


def _comment_live(con: duckdb.DuckDBPyConnection) -> None:
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
