"""Dagster's SQLite event log, with a batch of asset events written in one transaction a shard.

Stock `store_event_batch` is a loop: two transactions, a new engine and about twelve fsyncs an event, 19 to 59 s per
1,000 partitions and asset. And stock makes and serialises an event of 2 kB for every partition of a step, though they
differ in nothing but the partition: here one is made, and its text serves the others (`stands_for`). Schema and files
are unchanged, so stock Dagster reads what this class wrote; the page of a run shows one line an asset and not one a
partition. It leans on private API: Dagster is pinned to one minor version, and a test compares the tables with stock's.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Self

from dagster import AssetKey, DagsterEventType, MultiPartitionKey
from dagster._core.definitions.partitions.utils.multi import get_tags_from_multi_partition_key
from dagster._core.events import ASSET_EVENTS
from dagster._core.events.log import EventLogEntry
from dagster._core.storage.event_log.schema import AssetEventTagsTable, SqlEventLogStorageTable
from dagster._core.storage.event_log.sqlite import SqliteEventLogStorage
from dagster._serdes import ConfigurableClassData

BATCH_EVENTS = 1000
_PLANNED, _MADE = DagsterEventType.ASSET_MATERIALIZATION_PLANNED, DagsterEventType.ASSET_MATERIALIZATION


def batch_events() -> None:
    """Make Dagster hand over asset events in batches; a user's own setting stays."""
    os.environ.setdefault("DAGSTER_EVENT_BATCH_SIZE", str(BATCH_EVENTS))


@dataclass(frozen=True, slots=True)
class _Series:
    """Events that differ only in their partition: the first as it was handed over, its row, and all partitions."""

    event: EventLogEntry
    row: dict[str, Any]
    tags: Mapping[str, str]
    partitions: Sequence[str | None]

    def rows(self) -> Iterator[dict[str, Any]]:
        """The row of every partition."""
        for partition in self.partitions:
            yield self.row | {"partition": partition, "event": self._text(partition)}

    def tag_rows(self, ids: Sequence[int]) -> Iterator[dict[str, Any]]:
        """Rows of the tag table, for the events' ids."""
        same = {"asset_key": self.row["asset_key"], "event_timestamp": self.row["timestamp"]}
        for event_id, partition in zip(ids, self.partitions, strict=True):
            for key, value in (self.tags | _dimensions(partition) if self.tags else {}).items():
                yield {"event_id": event_id, "key": key, "value": value, **same}

    def _text(self, partition: str | None) -> str:
        first, text = self.row["partition"], str(self.row["event"])
        if partition == first:
            return text
        text = text.replace(f'"partition": {json.dumps(first)}', f'"partition": {json.dumps(partition)}')
        for key, value in _dimensions(partition).items():
            text = text.replace(f'"{key}": {json.dumps(_dimensions(first)[key])}', f'"{key}": {json.dumps(value)}')
        return text


def _what(event: EventLogEntry) -> tuple[str, DagsterEventType | None, AssetKey]:
    return event.run_id, event.dagster_event_type, event.get_dagster_event().asset_key


def _dimensions(partition: str | None) -> dict[str, str]:
    return dict(get_tags_from_multi_partition_key(partition)) if isinstance(partition, MultiPartitionKey) else {}


class BatchedSqliteEventLogStorage(SqliteEventLogStorage):
    """The embedded default: same tables as stock, a transaction a batch instead of two an event."""

    def __init__(self, base_dir: str, inst_data: ConfigurableClassData | None = None) -> None:
        super().__init__(base_dir, inst_data)
        self._alike: dict[tuple[str, AssetKey], Sequence[MultiPartitionKey]] = {}

    @classmethod
    def from_config_value(cls, inst_data: ConfigurableClassData | None, config_value: Mapping[str, Any]) -> Self:
        """Built from `dagster.yaml`; stock names its own class here."""
        return cls(inst_data=inst_data, **config_value)

    def stands_for(self, run_id: str, asset_key: AssetKey, partitions: Sequence[MultiPartitionKey]) -> None:
        """Let the run's next materialisation of the asset, that of the first partition, count for all of these."""
        self._alike[run_id, asset_key] = partitions

    def store_event(self, event: EventLogEntry) -> None:
        """Store one event, as a batch where it stands for others."""
        if event.is_dagster_event and event.dagster_event_type == _MADE and _what(event)[::2] in self._alike:
            self.store_event_batch([event])
        else:
            super().store_event(event)

    def store_event_batch(self, events: Sequence[EventLogEntry]) -> None:
        """Store events of one or more runs: asset events together, the few others (planned checks) the stock way."""
        together = [e for e in events if e.is_dagster_event and e.dagster_event_type in ASSET_EVENTS]
        for event in events:
            if not (event.is_dagster_event and event.dagster_event_type in ASSET_EVENTS):
                self.store_event(event)
        series = list(self._series(together))
        for run_id, own in groupby(series, key=lambda s: s.event.run_id):
            with self.run_connection(run_id) as conn:
                conn.execute(SqlEventLogStorageTable.insert(), [s.row for s in own])
        if series:
            self._mirror(series)

    def _series(self, events: Sequence[EventLogEntry]) -> Iterator[_Series]:
        """Planned cells of an asset follow each other in a batch; of made ones, one stands for all."""
        for (run_id, kind, asset_key), found in groupby(events, key=_what):
            alike = list(found)
            own = [e.get_dagster_event().partition for e in alike]
            if kind == _PLANNED:
                yield self._one(alike[0], own)
                continue
            for event, partition in zip(alike, own, strict=True):
                stands = self._alike.pop((run_id, asset_key), None) if kind == _MADE else None
                yield self._one(event, stands or [partition])

    def _one(self, event: EventLogEntry, partitions: Sequence[str | None]) -> _Series:
        return _Series(event, self._event_to_row(event), self._tags_for_asset_event(event), partitions)

    def _mirror(self, series: Sequence[_Series]) -> None:
        """Copy the events to the cross-run index with their tags; of each asset the newest of a type counts."""
        insert = SqlEventLogStorageTable.insert().returning(SqlEventLogStorageTable.c.id, sort_by_parameter_order=True)
        with self.index_transaction() as conn:
            newest, tags = {}, []
            for one in series:
                ids = conn.execute(insert, list(one.rows())).scalars().all()
                tags += one.tag_rows(ids)
                newest[one.row["asset_key"], one.event.dagster_event_type] = one.event, ids[-1]
            if tags:
                conn.execute(AssetEventTagsTable.insert(), tags)
            for event, event_id in newest.values():
                self._store_asset_event(conn, event, event_id)
