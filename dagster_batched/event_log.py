"""Write Dagster's event log in SQLite with the events of a step in groups, one transaction a file.

Stock writes each in two transactions, with a new engine and about twelve fsyncs: 19 to 59 s per 1,000 partitions and
asset. Here equal events are written at once (`coalescing`), and a run's shard starts as a copy of an empty one. Schema
and files are unchanged, so stock Dagster reads them; the page of a run shows one line an asset and not one a partition.
It depends on private API: Dagster's version is limited, and a test compares the tables with stock's.
"""

import os
import sqlite3
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from datetime import datetime
from itertools import groupby
from pathlib import Path
from typing import Any, Self

import dagster as dg
from dagster._core.storage.dagster_run import FINISHED_STATUSES
from dagster._core.storage.event_log.schema import SqlEventLogStorageTable
from dagster._core.storage.event_log.sqlite import SqliteEventLogStorage
from dagster._core.storage.event_log.sqlite.sqlite_event_log import INDEX_SHARD_NAME
from dagster._serdes import ConfigurableClassData
from sqlalchemy import Connection, Engine, create_engine

from dagster_batched.coalescing import INDEXED, CoalescingEventLog
from dagster_batched.event_group import EventGroup

_PAGE_BYTES = 8192  # of the index: an event and its columns take a third of 4 kB, and a little more; an eighth less
_RUN_PAGE_BYTES = 1024  # of a run: ten tables and fifteen indexes, all but empty, are half of it in pages of 4 kB
_BUSY_S = 30  # stock's value, which has no name in some versions
_COMMON = "run_id, dagster_event_type, step_key, asset_key"
# bound values take half the time of copying the first row within SQLite
_SELECT_FIRST = f"select {_COMMON} from event_logs where id = ?"
_INSERT_OTHER = f"insert into event_logs ({_COMMON}, timestamp, partition, event) values (?, ?, ?, ?, ?, ?, ?)"
_INSERT_TAG = "insert into asset_event_tags (event_timestamp, asset_key, event_id, key, value) values (?, ?, ?, ?, ?)"


class BatchedSqliteEventLogStorage(CoalescingEventLog, SqliteEventLogStorage):
    """Embedded event log: stock's tables, one transaction for many events instead of two for each."""

    def __init__(self, base_dir: str, inst_data: ConfigurableClassData | None = None) -> None:
        self._engines: dict[str, Engine] = {}
        self._open: dict[str, Connection] = {}
        self._shards = threading.RLock()
        self._existing: set[tuple[str, str]] = set()
        self._empty_shard: bytes | None = None
        index = Path(base_dir) / f"{INDEX_SHARD_NAME}.db"
        if not index.exists():
            index.parent.mkdir(parents=True, exist_ok=True)
            _write_new_file(index, _blank(_PAGE_BYTES))
        super().__init__(base_dir, inst_data)
        # a process that was killed while making the index leaves a file without tables, which stock accepts
        self._engine(INDEX_SHARD_NAME)
        self.reindex_events()
        self.reindex_assets()

    @classmethod
    def from_config_value(cls, inst_data: ConfigurableClassData | None, config_value: Mapping[str, Any]) -> Self:
        """Build from `dagster.yaml`; stock names its own class here."""
        return cls(inst_data=inst_data, **config_value)

    @contextmanager
    def _connect(self, shard: str) -> Iterator[Connection]:
        """Open a transaction on a shard, or join one that is open.

        Stock makes an engine for each, which takes longer than the write.
        """
        with self._shards:
            if shard in self._open:
                yield self._open[shard]
                return
            with self._engine(shard).connect() as conn, conn.begin():
                self._open[shard] = conn
                try:
                    yield conn
                finally:
                    del self._open[shard]

    def _index(self) -> Any:
        return self.index_connection()

    def _engine(self, shard: str) -> Engine:
        if shard not in self._engines:
            for shard_ in set(self._engines) - {INDEX_SHARD_NAME, *self._open}:  # no run is opened again
                self._engines.pop(shard_).dispose()
            wait = {"timeout": _BUSY_S}
            self._engines[shard] = create_engine(self.conn_string_for_shard(shard), connect_args=wait)
            if shard not in self._initialized_dbs:
                self._create(shard)
                self._initialized_dbs.add(shard)
        return self._engines[shard]

    def _create(self, shard: str) -> None:
        """Create a shard's tables; a run's shard is a copy of the first one."""
        path = Path(self.path_for_shard(shard))
        is_new = shard != INDEX_SHARD_NAME and not path.exists()
        if is_new and _write_new_file(path, self._empty_shard or _blank(_RUN_PAGE_BYTES)) and self._empty_shard:
            return
        self._initdb(self._engines[shard])
        if is_new:
            with closing(sqlite3.connect(path)) as con:
                self._empty_shard = con.serialize()

    def has_table(self, table_name: str) -> bool:
        """Return whether the index has a table."""
        return self._exists("table", super().has_table, table_name)

    def has_asset_key_col(self, column_name: str) -> bool:
        """Return whether the index's table of assets has a column."""
        return self._exists("column", super().has_asset_key_col, column_name)

    def has_secondary_index(self, name: str) -> bool:
        """Return whether a migration of the index is done."""
        return self._exists("index", super().has_secondary_index, name)

    def _exists(self, kind: str, query: Callable[[str], bool], name: str) -> bool:
        """Query until it exists, and cache that; stock queries for every event."""
        if (kind, name) not in self._existing and query(name):
            self._existing.add((kind, name))
        return (kind, name) in self._existing

    def dispose(self) -> None:
        """Close the files."""
        super().dispose()
        for engine in self._engines.values():
            engine.dispose()
        self._engines.clear()

    def _store(self, groups: Sequence[EventGroup]) -> None:
        """Store in each run's own shard first, since the index refers to it."""
        for run_id, own in groupby(groups, key=lambda g: g.event.run_id):
            with self.run_connection(run_id) as conn:
                conn.execute(SqlEventLogStorageTable.insert(), [s.row for s in own])
        index_groups = [g for g in groups if g.event.dagster_event_type in INDEXED]
        if index_groups:
            self._write_index(index_groups)

    def _insert(self, conn: Connection, one: EventGroup) -> int:
        """Insert a group; the id of its last row. Ids are consecutive, since the first insert holds the write lock."""
        key = conn.execute(SqlEventLogStorageTable.insert(), one.row).inserted_primary_key
        assert key is not None
        first = int(key[0])
        self.store_asset_event_tags([one.event], [first])  # within the same transaction
        others = list(one.others()) if len(one.partitions) > 1 else []
        if others:
            common = conn.exec_driver_sql(_SELECT_FIRST, (first,)).one()
            times = [f"{o.at:%Y-%m-%d %H:%M:%S.%f}" for o in others]
            rows = [(*common, at, o.partition, o.event) for o, at in zip(others, times, strict=True)]
            conn.exec_driver_sql(_INSERT_OTHER, rows)
            numbers = enumerate(zip(others, times, strict=True), first + 1)
            if tags := [(at, common.asset_key, i, *tag) for i, (o, at) in numbers for tag in o.tags.items()]:
                conn.exec_driver_sql(_INSERT_TAG, tags)
        return first + len(others)


def _blank(page_bytes: int) -> bytes:
    """Make a database without tables, with pages of that size."""
    with closing(sqlite3.connect(":memory:")) as con:
        con.execute(f"pragma page_size = {page_bytes}")
        con.execute("vacuum")
        return con.serialize()


def _write_new_file(path: Path, data: bytes) -> bool:
    """Write a new file, synced; False where another process was first, or writing failed."""
    copy = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with open(copy, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.link(copy, path)
    except OSError:
        return False
    finally:
        copy.unlink(missing_ok=True)
    return True


def delete_runs(instance: dg.DagsterInstance, before: datetime) -> int:
    """Delete runs that ended before a time, with their events; their number.

    Cells without a later run then show as not materialized; what is stored and stale is in the ledger.
    """
    run_filter = dg.RunsFilter(statuses=list(FINISHED_STATUSES), updated_before=before)
    runs = instance.get_runs(run_filter)
    log = instance.event_log_storage
    for run in runs:
        instance.delete_run(run.run_id)
        if isinstance(log, BatchedSqliteEventLogStorage):
            _remove(Path(log.path_for_shard(run.run_id)))
    return len(runs)


def _remove(shard: Path) -> None:
    """Delete a run's own file, and SQLite's files beside it."""
    for end in ("", "-wal", "-shm"):
        shard.with_name(shard.name + end).unlink(missing_ok=True)
