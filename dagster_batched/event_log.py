"""Dagster's event log in SQLite, with the events of a step written in groups and in one transaction a file.

Stock writes each in two transactions of its own, with a new engine and about twelve fsyncs: 19 to 59 s per 1,000
partitions and asset. Here those that stand alike are written at once (`coalescing`), and a run's shard begins as a copy
of the one before. Schema and files are unchanged, so stock Dagster reads what this class wrote; the page of a run shows
one line an asset and not one a partition. It leans on private API: Dagster is held between two versions, and a test
compares the tables with stock's.
"""

import os
import sqlite3
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any, Self

from dagster._core.storage.event_log.schema import SqlEventLogStorageTable
from dagster._core.storage.event_log.sqlite import SqliteEventLogStorage
from dagster._core.storage.event_log.sqlite.sqlite_event_log import INDEX_SHARD_NAME
from dagster._serdes import ConfigurableClassData
from sqlalchemy import Connection, Engine, create_engine

from dagster_batched.coalescing import INDEXED, CoalescingEventLog
from dagster_batched.event_group import EventGroup

_PAGE_BYTES = 8192  # of the index: an event and its columns take a third of 4 kB, and a little more; an eighth less
_RUN_PAGE_BYTES = 1024  # of a run: ten tables and fifteen indexes, all but empty, are half of it in pages of 4 kB
_BUSY_S = 30  # as stock has it, which gives it no name in every version
_SHARED = "run_id, dagster_event_type, step_key, asset_key"
# bound values cost half of what a copy of the first row within SQLite does
_FIRST = f"select {_SHARED} from event_logs where id = ?"
_ALIKE = f"insert into event_logs ({_SHARED}, timestamp, partition, event) values (?, ?, ?, ?, ?, ?, ?)"
_ALIKE_TAG = "insert into asset_event_tags (event_timestamp, asset_key, event_id, key, value) values (?, ?, ?, ?, ?)"


class BatchedSqliteEventLogStorage(CoalescingEventLog, SqliteEventLogStorage):
    """The embedded default: same tables as stock, a transaction for many events instead of two for each."""

    def __init__(self, base_dir: str, inst_data: ConfigurableClassData | None = None) -> None:
        self._engines: dict[str, Engine] = {}
        self._open: dict[str, Connection] = {}
        self._shards = threading.RLock()
        self._there: set[tuple[str, str]] = set()
        self._empty: bytes | None = None
        index = Path(base_dir) / f"{INDEX_SHARD_NAME}.db"
        if not index.exists():
            index.parent.mkdir(parents=True, exist_ok=True)
            _written_whole(index, _blank(_PAGE_BYTES))
        super().__init__(base_dir, inst_data)
        # whoever was killed while making the index left a file without tables, and stock takes any file for a whole one
        self._engine(INDEX_SHARD_NAME)
        self.reindex_events()
        self.reindex_assets()

    @classmethod
    def from_config_value(cls, inst_data: ConfigurableClassData | None, config_value: Mapping[str, Any]) -> Self:
        """Built from `dagster.yaml`; stock names its own class here."""
        return cls(inst_data=inst_data, **config_value)

    @contextmanager
    def _connect(self, shard: str) -> Iterator[Connection]:
        """A transaction on a shard; within another on the same shard, a part of that.

        Stock makes an engine for each, which costs more than what is then written.
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
            for earlier in set(self._engines) - {INDEX_SHARD_NAME, *self._open}:  # a run is left for good
                self._engines.pop(earlier).dispose()
            wait = {"timeout": _BUSY_S}
            self._engines[shard] = create_engine(self.conn_string_for_shard(shard), connect_args=wait)
            if shard not in self._initialized_dbs:
                self._begin(shard)
                self._initialized_dbs.add(shard)
        return self._engines[shard]

    def _begin(self, shard: str) -> None:
        """Let a shard have its tables; a run's is a copy of the first that was made."""
        path = Path(self.path_for_shard(shard))
        is_new = shard != INDEX_SHARD_NAME and not path.exists()
        if is_new and _written_whole(path, self._empty or _blank(_RUN_PAGE_BYTES)) and self._empty:
            return
        self._initdb(self._engines[shard])
        if is_new:
            with closing(sqlite3.connect(path)) as made:
                self._empty = made.serialize()

    def has_table(self, table_name: str) -> bool:
        """Whether the index has a table."""
        return self._stays("table", super().has_table, table_name)

    def has_asset_key_col(self, column_name: str) -> bool:
        """Whether the index's table of assets has a column."""
        return self._stays("column", super().has_asset_key_col, column_name)

    def has_secondary_index(self, name: str) -> bool:
        """Whether a migration of the index is done."""
        return self._stays("index", super().has_secondary_index, name)

    def _stays(self, kind: str, ask: Callable[[str], bool], name: str) -> bool:
        """Ask until it is there, for then it stays; stock asks for every event."""
        if (kind, name) not in self._there and ask(name):
            self._there.add((kind, name))
        return (kind, name) in self._there

    def dispose(self) -> None:
        """Let go of the files."""
        super().dispose()
        for engine in self._engines.values():
            engine.dispose()
        self._engines.clear()

    def _store(self, groups: Sequence[EventGroup]) -> None:
        """Each run's own shard first: what the index tells of a run can then be read there."""
        for run_id, own in groupby(groups, key=lambda g: g.event.run_id):
            with self.run_connection(run_id) as conn:
                conn.execute(SqlEventLogStorageTable.insert(), [s.row for s in own])
        crossing = [g for g in groups if g.event.dagster_event_type in INDEXED]
        if crossing:
            self._mirror(crossing)

    def _written(self, conn: Connection, one: EventGroup) -> int:
        """Id of the group's last row; ids follow each other, for the first insert holds the shard's only write lock."""
        key = conn.execute(SqlEventLogStorageTable.insert(), one.row).inserted_primary_key
        assert key is not None
        first = int(key[0])
        self.store_asset_event_tags([one.event], [first])  # within the same transaction
        others = list(one.others()) if len(one.partitions) > 1 else []
        if others:
            shared = conn.exec_driver_sql(_FIRST, (first,)).one()
            times = [f"{o.at:%Y-%m-%d %H:%M:%S.%f}" for o in others]
            rows = [(*shared, at, o.partition, o.event) for o, at in zip(others, times, strict=True)]
            conn.exec_driver_sql(_ALIKE, rows)
            placed = enumerate(zip(others, times, strict=True), first + 1)
            if tags := [(at, shared.asset_key, i, *tag) for i, (o, at) in placed for tag in o.tags.items()]:
                conn.exec_driver_sql(_ALIKE_TAG, tags)
        return first + len(others)


def _blank(page_bytes: int) -> bytes:
    """A database without tables, of pages of that size."""
    with closing(sqlite3.connect(":memory:")) as made:
        made.execute(f"pragma page_size = {page_bytes}")
        made.execute("vacuum")
        return made.serialize()


def _written_whole(path: Path, data: bytes) -> bool:
    """Whether there is now a new file of these bytes, synced; False where another process was first, or it can't be."""
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
