"""The catalog as an earlier night published it: the views of today over the tables of then."""

from pathlib import Path

import duckdb

from hdt_core.tables import TABLES
from pipelines.storage.catalog import lock
from pipelines.storage.delta import DamageError
from pipelines.storage.ledger import Ledger
from pipelines.storage.objects import StoreError
from pipelines.storage.publication import fill
from pipelines.storage.store import EMPTY, Store
from pipelines.storage.upkeep import night_by


def connect_as_of(home: Path, night: str) -> duckdb.DuckDBPyConnection:
    """What was believed after the last night that ended at or before `night`, a date or the beginning of a time in UTC.

    Every file that is named is read once, and must be what was written.

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
    lock(con, store, f"{store.root}/")
    return con
