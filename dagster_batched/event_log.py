"""Dagster's event log, with the events of a step written in groups and in one transaction a file.

Stock writes each in two transactions of its own, with a new engine and about twelve fsyncs: 19 to 59 s per 1,000
partitions and asset. Here those that stand alike are one group (`represents`), written at once, and a run's shard
begins as a copy of the one before. What a run plans is one event an asset; cells appear as planned only where the run
failed (`mark_failed_partitions`), since one that succeeded has materialised them. Events that only tell how far a step
is wait for the next that matters. Schema and files are unchanged, so stock Dagster reads what this class wrote; the
page of a run shows one line an asset and not one a partition. It leans on private API: Dagster is held between two
versions, and a test compares the tables with stock's.
"""

import os
import sqlite3
import threading
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

from dagster_batched.event_group import EventGroup
from dagster_batched.partitions import uncollected

_PLANNED, _MADE = DagsterEventType.ASSET_MATERIALIZATION_PLANNED, DagsterEventType.ASSET_MATERIALIZATION
_PATIENT = {
    DagsterEventType.RESOURCE_INIT_STARTED,
    DagsterEventType.RESOURCE_INIT_SUCCESS,
    DagsterEventType.LOGS_CAPTURED,
    DagsterEventType.STEP_OUTPUT,
    DagsterEventType.HANDLED_OUTPUT,
    DagsterEventType.ASSET_CHECK_EVALUATION,
}
"""Always followed, in the same process, by the start, the end or a materialisation of a step."""
_INDEXED = ASSET_EVENTS | ASSET_CHECK_EVENTS | set(EVENT_TYPE_TO_PIPELINE_RUN_STATUS)
"""Of these the index of all runs tells."""
_PAGE_BYTES = 8192  # of the index: an event and its columns take a third of 4 kB, and a little more; an eighth less
_RUN_PAGE_BYTES = 1024  # of a run: ten tables and fifteen indexes, all but empty, are half of it in pages of 4 kB
_MOST_NAMED = 30_000  # partitions or events in one question: SQLite takes 32,766 values
_BUSY_S = 30  # as stock has it, which gives it no name in every version
_SHARED = "run_id, dagster_event_type, step_key, asset_key"
# bound values cost half of what a copy of the first row within SQLite does
_FIRST = f"select {_SHARED} from event_logs where id = ?"
_ALIKE = f"insert into event_logs ({_SHARED}, timestamp, partition, event) values (?, ?, ?, ?, ?, ?, ?)"
_ALIKE_TAG = "insert into asset_event_tags (event_timestamp, asset_key, event_id, key, value) values (?, ?, ?, ?, ?)"


class CoalescingEventLog(SqlEventLogStorage):
    """An event log in which one event may stand for those that differ in nothing but the partition.

    To be mixed in before one of Dagster's; whoever does says how groups are stored.
    """

    supports_partition_subset_in_asset_materialization_planned_events = True

    def __init__(self, *args: Any, **settings: Any) -> None:
        self._alike: dict[tuple[str, AssetKey], tuple[Sequence[str], Sequence[Mapping[str, int]]]] = {}
        self._waiting: list[EventLogEntry] = []
        super().__init__(*args, **settings)  # type: ignore[no-untyped-call]

    @abstractmethod
    def _store(self, groups: Sequence[EventGroup]) -> None:
        """Store them, together."""

    @abstractmethod
    def _index(self) -> AbstractContextManager[Connection]:
        """A transaction on the index of all runs; what stock's own methods write within it is a part of it."""

    @abstractmethod
    def _written(self, conn: Connection, one: EventGroup) -> int:
        """Id of the group's last row, once it is in the index."""

    def represents(
        self, run_id: str, asset_key: AssetKey, partitions: Sequence[str], numbers: Sequence[Mapping[str, int]] = ()
    ) -> None:
        """Let the run's next materialisation of the asset, that of the first partition, count for all of these.

        `numbers` are what the others' events tell as metadata, one mapping a partition, the first's among them.
        """
        self._alike[run_id, asset_key] = partitions, numbers

    def mark_failed_partitions(self, run_id: str, partitions: Sequence[str]) -> None:
        """Show these partitions as planned for every asset that the failed run did not materialise."""
        made = {e.get_dagster_event().asset_key for e in self.get_logs_for_run(run_id, of_type=_MADE)}
        planned = self.get_logs_for_run(run_id, of_type=_PLANNED)
        self._mirror([self._one(e, partitions) for e in planned if _what(e)[1] not in made])

    def store_event(self, event: EventLogEntry) -> None:
        """Store one event, and those that waited for it."""
        self.store_event_batch([event])

    def store_event_batch(self, events: Sequence[EventLogEntry]) -> None:
        """Store events of one or more runs in one transaction, with those that waited."""
        self._waiting += events
        if not all(e.dagster_event_type in _PATIENT for e in events):
            due, self._waiting = self._waiting, []
            self._store([self._one(e, *self._partitions(e)) for e in due])

    @uncollected()
    def get_materialized_partitions(
        self, asset_key: AssetKey, before_cursor: int | None = None, after_cursor: int | None = None
    ) -> set[str]:
        """Partitions that were made, as stock finds them."""
        return super().get_materialized_partitions(asset_key, before_cursor, after_cursor)

    def get_latest_asset_partition_materialization_attempts_without_materializations(
        self, asset_key: AssetKey, after_storage_id: int | None = None
    ) -> dict[str, tuple[str, int]]:
        """Run and event of each partition that was planned and not made since.

        Looks for what was made among the partitions that were planned: few here, while stock reads all that were made.
        """
        latest = self.get_latest_storage_id_by_partition
        planned = {p: i for p, i in latest(asset_key, _PLANNED).items() if i > (after_storage_id or 0)}
        asked = set(planned) if len(planned) <= _MOST_NAMED else None
        made = latest(asset_key, _MADE, asked) if planned else {}
        left = {i: p for p, i in planned.items() if i > made.get(p, 0)}
        ids, kept, found = list(left), SqlEventLogStorageTable.c, dict[str, tuple[str, int]]()
        with self.index_connection() as conn:
            for at in range(0, len(ids), _MOST_NAMED):
                own = kept.id.in_(ids[at : at + _MOST_NAMED])
                found |= {left[i]: (run_id, i) for i, run_id in conn.execute(select(kept.id, kept.run_id).where(own))}
        return found

    def _mirror(self, groups: Sequence[EventGroup]) -> None:
        """Write the groups into the index with their tags; of each asset the newest of a type counts."""
        newest: dict[tuple[Any, DagsterEventType | None], tuple[EventLogEntry, int]] = {}
        with self._index() as conn:
            for one in groups:
                event_id = self._written(conn, one)
                kind = one.event.dagster_event_type
                if kind in ASSET_EVENTS:
                    newest[one.row["asset_key"], kind] = one.event, event_id
                elif kind in ASSET_CHECK_EVENTS:
                    if kind == DagsterEventType.ASSET_CHECK_EVALUATION:
                        _place_last(conn, one.event)
                    self.store_asset_check_event(one.event, event_id)
            for event, event_id in newest.values():
                self.store_asset_event(event, event_id)

    def _partitions(self, event: EventLogEntry) -> tuple[Sequence[str | None], Sequence[Mapping[str, int]]]:
        """Partitions that the event stands for, and their numbers."""
        if event.dagster_event_type not in ASSET_EVENTS:
            return [None], ()
        stands = self._alike.pop(_what(event), None) if event.dagster_event_type == _MADE else None
        return stands or ([event.get_dagster_event().partition], ())

    def _one(
        self, event: EventLogEntry, partitions: Sequence[str | None], numbers: Sequence[Mapping[str, int]] = ()
    ) -> EventGroup:
        if event.dagster_event_type == _PLANNED:
            event = _of(event, partitions[0])  # the run's tags name its range; its keys once more would be 100 kB
        return EventGroup(event, self._event_to_row(event), self._tags_for_asset_event(event), partitions, numbers)


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
        crossing = [g for g in groups if g.event.dagster_event_type in _INDEXED]
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


def _what(event: EventLogEntry) -> tuple[str, AssetKey]:
    """Run and asset of an asset's event."""
    key = event.get_dagster_event().asset_key
    assert key is not None
    return event.run_id, key


def _place_last(conn: Connection, event: EventLogEntry) -> None:
    """Move what the run planned of a check behind what runs beside it planned meanwhile.

    A page holds the last record of a check against the last materialisation, and says that nothing was checked where
    they are of two runs. An evaluation comes with its materialisation, in one transaction.
    """
    said, kept = event.get_dagster_event().asset_check_evaluation_data, AssetCheckExecutionsTable.c
    of_check = and_(kept.asset_key == said.asset_key.to_string(), kept.check_name == said.check_name)
    own = and_(of_check, kept.run_id == event.run_id)
    last = conn.execute(select(func.max(kept.id)).where(of_check)).scalar()
    names = [c for c in AssetCheckExecutionsTable.columns if c.name not in ("id", "create_timestamp")]
    planned = conn.execute(select(*names, kept.id).where(own)).mappings().all()
    if planned and last not in {row["id"] for row in planned}:
        conn.execute(AssetCheckExecutionsTable.delete().where(own))
        conn.execute(AssetCheckExecutionsTable.insert(), [{c.name: row[c.name] for c in names} for row in planned])


def _of(event: EventLogEntry, partition: str | None) -> EventLogEntry:
    """The same plan for one partition, or for the run's."""
    planned = event.get_dagster_event()
    data = AssetMaterializationPlannedData(_what(event)[1], partition)
    return event._replace(dagster_event=planned._replace(event_specific_data=data))


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
