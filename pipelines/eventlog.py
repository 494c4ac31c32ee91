"""Dagster's SQLite event log, with a batch of asset events written in one transaction a shard.

Stock `store_event_batch` is a loop: two transactions, a new engine and about twelve fsyncs an event, 19 to 59 s per
1,000 partitions and asset. And stock makes and serialises an event of 2 kB for every partition of a step, though they
differ in nothing but the partition: here one is made, and its text, less what it tells of the run, serves the others
(`stands_for`). What a run plans
is one event an asset; cells appear as planned only where the run failed (`planned_in_vain`), since one that succeeded
has materialised them. Schema and files are unchanged, so stock Dagster reads what this class wrote; the page of a run
shows one line an asset and not one a partition. It leans on private API: Dagster is pinned to one minor version, and a
test compares the tables with stock's.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Self

from dagster import AssetKey, DagsterEventType, MultiPartitionKey
from dagster._core.definitions.partitions.utils.multi import get_tags_from_multi_partition_key
from dagster._core.events import ASSET_EVENTS, AssetMaterializationPlannedData
from dagster._core.events.log import EventLogEntry
from dagster._core.storage.event_log.schema import SqlEventLogStorageTable
from dagster._core.storage.event_log.sqlite import SqliteEventLogStorage
from dagster._core.storage.event_log.sqlite.sqlite_event_log import INDEX_SHARD_NAME, SQLITE_BUSY_TIMEOUT_SECONDS
from dagster._serdes import ConfigurableClassData
from sqlalchemy import Connection, Engine, create_engine, text

BATCH_EVENTS = 1000
_PLANNED, _MADE = DagsterEventType.ASSET_MATERIALIZATION_PLANNED, DagsterEventType.ASSET_MATERIALIZATION
# a further row of the index, and of its tags, is the series' first but for what names the partition
_ALIKE = text(
    "insert into event_logs (run_id, event, dagster_event_type, timestamp, step_key, asset_key, partition)"
    " select run_id, :event, dagster_event_type, timestamp, step_key, asset_key, :partition"
    " from event_logs where id = :first"
)
_ALIKE_TAG = text(
    "insert into asset_event_tags (event_id, asset_key, key, value, event_timestamp)"
    " select :id, asset_key, key, :value, event_timestamp from asset_event_tags where event_id = :first and key = :key"
)


def batch_events() -> None:
    """Make Dagster hand over asset events in batches; a user's own setting stays."""
    os.environ.setdefault("DAGSTER_EVENT_BATCH_SIZE", str(BATCH_EVENTS))


@dataclass(frozen=True, slots=True)
class Series:
    """Events that differ only in their partition: the first as it was handed over, its row, and all partitions."""

    event: EventLogEntry
    row: dict[str, Any]
    tags: Mapping[str, str]
    partitions: Sequence[str | None]

    def others(self) -> Iterator[tuple[str, str, Mapping[str, str]]]:
        """Partition, event in Dagster's own text, and tags of all but the first."""
        pattern, names = _bare(str(self.row["event"])).replace("%", "%%"), {"partition": self.row["partition"]}
        for key, value in (names | _dimensions(self.row["partition"])).items():
            pattern = pattern.replace(f'"{key}": {json.dumps(value)}', f'"{key}": %({key})s')
        for partition in filter(None, self.partitions[1:]):
            own = _dimensions(partition)
            quoted = {key: json.dumps(value) for key, value in {"partition": partition, **own}.items()}
            yield partition, pattern % quoted, self.tags and {**self.tags, **own}


def _bare(event: str) -> str:
    """An event's text without the numbers of its run, which stand with the series' first: half of what is stored."""
    said = json.loads(event)
    said["dagster_event"]["logging_tags"] = {}
    made = said["dagster_event"]["event_specific_data"].get("materialization")
    if made:
        made["metadata_entries"] = []
    return json.dumps(said)


def _what(event: EventLogEntry) -> tuple[str, AssetKey | None]:
    return event.run_id, event.get_dagster_event().asset_key


def _dimensions(partition: str | None) -> dict[str, str]:
    return dict(get_tags_from_multi_partition_key(partition)) if isinstance(partition, MultiPartitionKey) else {}


class OneForMany:
    """What an event log needs to let one event stand for those that differ in nothing but the partition.

    Whoever mixes it in stores a series of them by `_mirror`.
    """

    supports_partition_subset_in_asset_materialization_planned_events = True
    _alike: dict[tuple[str, AssetKey | None], Sequence[MultiPartitionKey]]

    def stands_for(self, run_id: str, asset_key: AssetKey, partitions: Sequence[MultiPartitionKey]) -> None:
        """Let the run's next materialisation of the asset, that of the first partition, count for all of these."""
        self._alike[run_id, asset_key] = partitions

    def planned_in_vain(self, run_id: str, partitions: Sequence[str]) -> None:
        """Show these partitions as planned for every asset that the failed run did not materialise."""
        made = {e.get_dagster_event().asset_key for e in self.get_logs_for_run(run_id, of_type=_MADE)}
        planned = self.get_logs_for_run(run_id, of_type=_PLANNED)
        self._mirror([self._one(e, partitions) for e in planned if _what(e)[1] not in made])

    def _partitions(self, event: EventLogEntry) -> Sequence[str | None]:
        stands = self._alike.pop(_what(event), None) if event.dagster_event_type == _MADE else None
        return stands or [event.get_dagster_event().partition]

    def _one(self, event: EventLogEntry, partitions: Sequence[str | None]) -> Series:
        if event.dagster_event_type == _PLANNED:  # the run's tags name its range; its keys once more would be 100 kB
            event = _of(event, partitions[0])
        return Series(event, self._event_to_row(event), self._tags_for_asset_event(event), partitions)


class BatchedSqliteEventLogStorage(OneForMany, SqliteEventLogStorage):
    """The embedded default: same tables as stock, a transaction a batch instead of two an event."""

    def __init__(self, base_dir: str, inst_data: ConfigurableClassData | None = None) -> None:
        self._alike: dict[tuple[str, AssetKey | None], Sequence[MultiPartitionKey]] = {}
        self._engines: dict[str, Engine] = {}
        self._tables: set[str] = set()
        super().__init__(base_dir, inst_data)

    @classmethod
    def from_config_value(cls, inst_data: ConfigurableClassData | None, config_value: Mapping[str, Any]) -> Self:
        """Built from `dagster.yaml`; stock names its own class here."""
        return cls(inst_data=inst_data, **config_value)

    @contextmanager
    def _connect(self, shard: str) -> Iterator[Connection]:
        """A transaction on a shard. Stock makes an engine for each, which costs more than what is then written."""
        with self._db_lock, self._engine(shard).connect() as conn, conn.begin():
            yield conn

    def _engine(self, shard: str) -> Engine:
        if shard not in self._engines:
            for earlier in set(self._engines) - {INDEX_SHARD_NAME}:  # a run's shard is left for good with the run
                self._engines.pop(earlier).dispose()
            wait = {"timeout": SQLITE_BUSY_TIMEOUT_SECONDS}
            self._engines[shard] = create_engine(self.conn_string_for_shard(shard), connect_args=wait)
            if shard not in self._initialized_dbs:
                self._initdb(self._engines[shard])
                self._initialized_dbs.add(shard)
        return self._engines[shard]

    def has_table(self, table_name: str) -> bool:
        """Whether the index has a table; one that is there stays."""
        if table_name not in self._tables and super().has_table(table_name):
            self._tables.add(table_name)
        return table_name in self._tables

    def dispose(self) -> None:
        """Let go of the files."""
        super().dispose()
        for engine in self._engines.values():
            engine.dispose()
        self._engines.clear()

    def store_event(self, event: EventLogEntry) -> None:
        """Store one event, as a batch where it stands for others."""
        if event.is_dagster_event and event.dagster_event_type == _MADE and _what(event) in self._alike:
            self.store_event_batch([event])
        else:
            super().store_event(event)

    def store_event_batch(self, events: Sequence[EventLogEntry]) -> None:
        """Store events of one or more runs: asset events together, the few others (planned checks) the stock way."""
        together = [e for e in events if e.is_dagster_event and e.dagster_event_type in ASSET_EVENTS]
        for event in events:
            if not (event.is_dagster_event and event.dagster_event_type in ASSET_EVENTS):
                self.store_event(event)
        series = [self._one(e, self._partitions(e)) for e in together]
        for run_id, own in groupby(series, key=lambda s: s.event.run_id):
            with self.run_connection(run_id) as conn:
                conn.execute(SqlEventLogStorageTable.insert(), [s.row for s in own])
        if series:
            self._mirror(series)

    def _mirror(self, series: Sequence[Series]) -> None:
        """Copy the events to the cross-run index with their tags; of each asset the newest of a type counts."""
        with self.index_transaction() as conn:
            newest = {}
            for one in series:
                event_id = self._copied(conn, one)
                newest[one.row["asset_key"], one.event.dagster_event_type] = one.event, event_id
            for event, event_id in newest.values():
                self._store_asset_event(conn, event, event_id)

    def _copied(self, conn: Connection, one: Series) -> int:
        """Id of the series' last row; ids follow each other, for the first insert holds the shard's only write lock."""
        first = conn.execute(SqlEventLogStorageTable.insert(), one.row).inserted_primary_key[0]
        self._store_asset_event_tags(conn, [one.event], [first])
        rows, tags = [], []
        for event_id, (partition, event, own) in enumerate(one.others(), first + 1):
            rows.append({"event": event, "partition": partition, "first": first})
            tags += [{"id": event_id, "key": k, "value": v, "first": first} for k, v in own.items()]
        for statement, found in ((_ALIKE, rows), (_ALIKE_TAG, tags)):
            if found:
                conn.execute(statement, found)
        return int(first) + len(rows)


def _of(event: EventLogEntry, partition: str | None) -> EventLogEntry:
    """The same plan for one partition, or for the run's."""
    planned = event.get_dagster_event()
    data = AssetMaterializationPlannedData(_what(event)[1], partition)
    return event._replace(dagster_event=planned._replace(event_specific_data=data))
