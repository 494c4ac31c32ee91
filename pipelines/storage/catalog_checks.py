"""Check that the published catalog is whole, of this version, and of the home's tables as they are now."""

from pathlib import Path

import duckdb

from hdt_core.tables import TABLES
from pipelines.storage.catalog import CATALOG, connect, nights_of, open_catalog
from pipelines.storage.catalog_views import hash_place, hash_recipe
from pipelines.storage.ledger import Ledger
from pipelines.storage.objects import StoreError, message_of
from pipelines.storage.store import Store
from pipelines.storage.view_headers import views

ANOTHER_PLACE = "it was made for another place"


def connect_current(home: Path) -> duckdb.DuckDBPyConnection:
    """Open the catalog as `catalog.connect` does, for readers of views that differ between versions.

    Raises
    ------
    FileNotFoundError, StoreError
        As of `catalog.connect`; or another version published it.
    """
    con = connect(home)
    ((recipe_hash,),) = con.execute("select tables.made_as()").fetchall()
    if recipe_hash != hash_recipe():
        con.close()
        raise StoreError(f"the catalog in {home} was published by another version; `hdt nightly` publishes it again")
    return con


def find_catalog_fault(home: Path) -> str | None:
    """Check the catalog; the fault in words, None where it is whole, of this version and of this home's tables now."""
    return find_form_fault(home) or find_staleness(home)


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


def find_form_fault(home: Path) -> str | None:
    """Check that the catalog is readable, of this version and of this place; the fault in words, None without one."""
    if not (home / CATALOG).exists():
        return "it was missing"
    try:
        with open_catalog(home) as con:
            ((recipe_hash, place_hash),) = con.execute("select tables.made_as(), tables.made_for()").fetchall()
            con.execute("select max(path) from tables.files").fetchall()
            present = {v for (v,) in con.execute("select view_name from duckdb_views() where not internal").fetchall()}
    except duckdb.Error as error:
        return f"it could not be read ({message_of(error)})"
    if recipe_hash != hash_recipe():
        return "it was made by another version"
    if {*views(), *TABLES} - present:
        return "it lacked views"
    return None if place_hash == hash_place(Store(home.resolve())) else ANOTHER_PLACE
