"""Write events that differ only in the partition as one group, in any database; and Dagster's event log in SQLite.

A run's plan is one event an asset; cells appear as planned only where the run failed (`mark_failed_partitions`), since
a successful one has materialised them. Events of mere progress wait for the next important one.

Stock writes each event in two transactions, with a new engine and about twelve fsyncs. Here equal events are written at
once, one transaction a file, and a run's shard starts as a copy of an empty one. Schema and files are unchanged, so
stock Dagster reads them; the page of a run shows one line an asset and not one a partition.
"""

import os
import sqlite3
import threading
import weakref
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any, Self

from dagster import AssetKey, DagsterEventType
from dagster._core.events import (
    ASSET_CHECK_EVENTS,
    ASSET_EVENTS,
    EVENT_TYPE_TO_PIPELINE_RUN_STATUS,
    AssetMaterializationPlannedData,
)
from dagster._core.events.log import EventLogEntry
from dagster._core.storage.event_log.schema import AssetCheckExecutionsTable, SqlEventLogStorageTable
from dagster._core.storage.event_log.sql_event_log import SqlEventLogStorage
from dagster._core.storage.event_log.sqlite import SqliteEventLogStorage
from dagster._core.storage.event_log.sqlite.sqlite_event_log import INDEX_SHARD_NAME
from dagster._serdes import ConfigurableClassData
from sqlalchemy import Connection, Engine, and_, create_engine, func, select

from dagster_batched.partitions import EventGroup, without_garbage_collection

_PLANNED, _MATERIALIZED = DagsterEventType.ASSET_MATERIALIZATION_PLANNED, DagsterEventType.ASSET_MATERIALIZATION
_DEFERRED = {
    DagsterEventType.RESOURCE_INIT_STARTED,
    DagsterEventType.RESOURCE_INIT_SUCCESS,
    DagsterEventType.LOGS_CAPTURED,
    DagsterEventType.STEP_OUTPUT,
    DagsterEventType.HANDLED_OUTPUT,
    DagsterEventType.ASSET_CHECK_EVALUATION,
}
"""Types that are always followed, in the same process, by the start, end or a materialisation of a step."""
INDEXED = ASSET_EVENTS | ASSET_CHECK_EVENTS | set(EVENT_TYPE_TO_PIPELINE_RUN_STATUS)
"""Types in the index of all runs."""
_MAX_VALUES = 30_000  # partitions or events in one query: SQLite takes 32,766 values


class CoalescingEventLog(SqlEventLogStorage):
    """Mixin of an event log that handles events which differ only in the partition as one.

    It precedes one of Dagster's classes; the subclass stores the groups.
    """

    supports_partition_subset_in_asset_materialization_planned_events = True

    def __init__(self, *args: Any, **settings: Any) -> None:
        self._groups: dict[tuple[str, AssetKey | None], tuple[Sequence[str], Sequence[Mapping[str, int]]]] = {}
        self._deferred: list[EventLogEntry] = []
        super().__init__(*args, **settings)  # type: ignore[no-untyped-call]

    @abstractmethod
    def _store(self, groups: Sequence[EventGroup]) -> None:
        """Store groups together."""

    def transaction(self) -> AbstractContextManager[Connection]:
        """Open a transaction on the index of all runs, which stock's own methods join."""
        return self.index_connection()

    @abstractmethod
    def _insert(self, conn: Connection, one: EventGroup) -> int:
        """Insert a group into the index; the id of its last row."""

    def group_partitions(
        self, run_id: str, asset_key: AssetKey, partitions: Sequence[str], numbers: Sequence[Mapping[str, int]] = ()
    ) -> None:
        """Let the run's next materialisation of the asset, of the first partition, count for all of these.

        `numbers` are metadata of the events, one mapping a partition, the first included.
        """
        self._groups[run_id, asset_key] = partitions, numbers

    def mark_failed_partitions(self, run_id: str, partitions: Sequence[str]) -> None:
        """Show these partitions as planned for every asset that the failed run did not materialise."""
        done_assets = {e.get_dagster_event().asset_key for e in self.get_logs_for_run(run_id, of_type=_MATERIALIZED)}
        plans = self.get_logs_for_run(run_id, of_type=_PLANNED)
        self._write_index(
            [self._group(e, partitions) for e in plans if e.get_dagster_event().asset_key not in done_assets]
        )

    def store_event(self, event: EventLogEntry) -> None:
        """Store one event, and the deferred ones before it."""
        self.store_event_batch([event])

    def store_event_batch(self, events: Sequence[EventLogEntry]) -> None:
        """Store events of one or more runs in one transaction, with the deferred ones."""
        self._deferred += events
        if not all(e.dagster_event_type in _DEFERRED for e in events):
            pending = self._deferred
            self._deferred = []
            self._store([self._group(e, *self._partitions(e)) for e in pending])

    @without_garbage_collection()
    def get_materialized_partitions(
        self, asset_key: AssetKey, before_cursor: int | None = None, after_cursor: int | None = None
    ) -> set[str]:
        """List materialized partitions, as stock does."""
        return super().get_materialized_partitions(asset_key, before_cursor, after_cursor)

    def get_latest_asset_partition_materialization_attempts_without_materializations(
        self, asset_key: AssetKey, after_storage_id: int | None = None
    ) -> dict[str, tuple[str, int]]:
        """Map each partition that was planned and not materialized since to run and event.

        Searches among the planned partitions, which are few here, while stock reads all that were materialized.
        """
        latest = self.get_latest_storage_id_by_partition
        plan_ids = {p: i for p, i in latest(asset_key, _PLANNED).items() if i > (after_storage_id or 0)}
        partitions = set(plan_ids) if len(plan_ids) <= _MAX_VALUES else None
        event_ids = latest(asset_key, _MATERIALIZED, partitions) if plan_ids else {}
        open_plans = {i: p for p, i in plan_ids.items() if i > event_ids.get(p, 0)}
        ids = list(open_plans)
        columns = SqlEventLogStorageTable.c
        attempts = dict[str, tuple[str, int]]()
        with self.index_connection() as conn:
            for at in range(0, len(ids), _MAX_VALUES):
                rows = select(columns.id, columns.run_id).where(columns.id.in_(ids[at : at + _MAX_VALUES]))
                attempts |= {open_plans[i]: (run_id, i) for i, run_id in conn.execute(rows)}
        return attempts

    def _write_index(self, groups: Sequence[EventGroup]) -> None:
        """Write groups into the index with their tags; of each asset the newest of a type counts."""
        newest: dict[tuple[Any, DagsterEventType | None], tuple[EventLogEntry, int]] = {}
        with self.transaction() as conn:
            for one in groups:
                event_id = self._insert(conn, one)
                kind = one.event.dagster_event_type
                if kind in ASSET_EVENTS:
                    newest[one.row["asset_key"], kind] = one.event, event_id
                elif kind in ASSET_CHECK_EVENTS:
                    if kind == DagsterEventType.ASSET_CHECK_EVALUATION:
                        _move_check_last(conn, one.event)
                    self.store_asset_check_event(one.event, event_id)
            for event, event_id in newest.values():
                self.store_asset_event(event, event_id)

    def _partitions(self, event: EventLogEntry) -> tuple[Sequence[str | None], Sequence[Mapping[str, int]]]:
        """List the partitions of an event's group, and their numbers."""
        if event.dagster_event_type not in ASSET_EVENTS:
            return [None], ()
        one = event.get_dagster_event()
        is_materialized = event.dagster_event_type == _MATERIALIZED
        group = self._groups.pop((event.run_id, one.asset_key), None) if is_materialized else None
        return group or ([one.partition], ())

    def _group(
        self, event: EventLogEntry, partitions: Sequence[str | None], numbers: Sequence[Mapping[str, int]] = ()
    ) -> EventGroup:
        if event.dagster_event_type == _PLANNED:
            plan = event.get_dagster_event()  # the run's tags name its range; repeating its keys takes 100 kB
            data = AssetMaterializationPlannedData(plan.asset_materialization_planned_data.asset_key, partitions[0])
            event = event._replace(dagster_event=plan._replace(event_specific_data=data))
        return EventGroup(event, self._event_to_row(event), self._tags_for_asset_event(event), partitions, numbers)


def _move_check_last(conn: Connection, event: EventLogEntry) -> None:
    """Move a run's planned check behind those that parallel runs planned meanwhile.

    A page compares the last record of a check with the last materialisation, and shows the check as missing where they
    are of two runs. An evaluation comes with its materialisation, in one transaction.
    """
    evaluation = event.get_dagster_event().asset_check_evaluation_data
    columns = AssetCheckExecutionsTable.c
    of_check = and_(columns.asset_key == evaluation.asset_key.to_string(), columns.check_name == evaluation.check_name)
    own = and_(of_check, columns.run_id == event.run_id)
    last = conn.execute(select(func.max(columns.id)).where(of_check)).scalar()
    names = [c for c in AssetCheckExecutionsTable.columns if c.name not in ("id", "create_timestamp")]
    rows = conn.execute(select(*names, columns.id).where(own)).mappings().all()
    if rows and last not in {row["id"] for row in rows}:
        conn.execute(AssetCheckExecutionsTable.delete().where(own))
        conn.execute(AssetCheckExecutionsTable.insert(), [{c.name: row[c.name] for c in names} for row in rows])


_PAGE_BYTES = 8192  # of the index: an event and its columns take a third of 4 kB, and a little more; an eighth less
_RUN_PAGE_BYTES = 1024  # of a run: ten tables and fifteen indexes, all but empty, are half of it in pages of 4 kB
_BUSY_S = 30  # stock's value, which has no name in some versions
_COMMON = "run_id, dagster_event_type, step_key, asset_key"
# bound values take half the time of copying the first row within SQLite
_SELECT_FIRST = f"select {_COMMON} from event_logs where id = ?"
_INSERT_OTHER = f"insert into event_logs ({_COMMON}, timestamp, partition, event) values (?, ?, ?, ?, ?, ?, ?)"
_INSERT_TAG = "insert into asset_event_tags (event_timestamp, asset_key, event_id, key, value) values (?, ?, ?, ?, ?)"


def _close_files(engines: dict[str, Engine]) -> None:
    for engine in engines.values():
        engine.dispose()
    engines.clear()


class BatchedSqliteEventLogStorage(CoalescingEventLog, SqliteEventLogStorage):
    """Embedded event log: stock's tables, one transaction for many events instead of two for each."""

    def __init__(self, base_dir: str, inst_data: ConfigurableClassData | None = None) -> None:
        self._engines: dict[str, Engine] = {}
        # Dagster builds instances from a reference and disposes of none of them
        weakref.finalize(self, _close_files, self._engines)
        self._open: dict[str, Connection] = {}
        self._shards = threading.RLock()
        self._existing: set[tuple[str, str]] = set()
        self._empty_shard: bytes | None = None
        index = Path(base_dir) / f"{INDEX_SHARD_NAME}.db"
        if not index.exists():
            index.parent.mkdir(parents=True, exist_ok=True)
            _write_new_file(index, _blank(_PAGE_BYTES, "incremental"))
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
        _close_files(self._engines)

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


def _blank(page_bytes: int, auto_vacuum: str = "none") -> bytes:
    """Make a database without tables, with pages of that size; an incremental one can return free pages one by one."""
    with closing(sqlite3.connect(":memory:")) as con:
        con.execute(f"pragma page_size = {page_bytes}")
        con.execute(f"pragma auto_vacuum = {auto_vacuum}")
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
