"""What Dagster's event logs need so that a run of a thousand cells costs a few transactions and a few made-up texts.

Stock makes and serialises an event of 2 kB for every partition of a step, though they differ in nothing but the
partition: here one is made, and its text, less what it tells of the run, serves the others (`represents`). What a run
plans is one event an asset; cells appear as planned only where the run failed (`mark_failed_partitions`), since one
that succeeded has materialised them. Events that only tell how far a step is wait for the next that matters.
"""

import json
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache
from json.encoder import encode_basestring_ascii as _quoted
from typing import Any

from dagster import AssetKey, DagsterEventType, MultiPartitionKey
from dagster._core.events import (
    ASSET_CHECK_EVENTS,
    ASSET_EVENTS,
    EVENT_TYPE_TO_PIPELINE_RUN_STATUS,
    AssetMaterializationPlannedData,
)
from dagster._core.events.log import EventLogEntry
from dagster._core.storage.event_log.sql_event_log import SqlEventLogStorage
from dagster._core.storage.tags import get_multidimensional_partition_tag
from sqlalchemy import Connection

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


@dataclass(frozen=True, slots=True)
class EventGroup:
    """Events that differ only in their partition: the first as it was handed over, its row, and all partitions."""

    event: EventLogEntry
    row: dict[str, Any]
    tags: Mapping[str, str]
    partitions: Sequence[str | None]

    @property
    def type(self) -> DagsterEventType | None:
        """Of the events; None for a line of a log."""
        return self.event.dagster_event_type

    @property
    def crosses_runs(self) -> bool:
        """Whether it belongs into the index of all runs."""
        return self.type in ASSET_EVENTS | ASSET_CHECK_EVENTS or self.type in EVENT_TYPE_TO_PIPELINE_RUN_STATUS

    def others(self) -> Iterator[tuple[str, str, Mapping[str, str]]]:
        """Partition, event in Dagster's own text, and tags of all but the first."""
        if len(self.partitions) < 2:
            return
        pattern, names = _bare(str(self.row["event"])).replace("%", "%%"), {"partition": self.row["partition"]}
        for key, value in (names | _dimensions(self.row["partition"])).items():
            pattern = pattern.replace(f'"{key}": {json.dumps(value)}', f'"{key}": %({key})s')
        for partition in filter(None, self.partitions[1:]):
            own = _dimensions(partition)
            quoted = {key: _quoted(value) for key, value in own.items()}
            yield partition, pattern % (quoted | {"partition": _quoted(partition)}), self.tags and {**self.tags, **own}


def _bare(event: str) -> str:
    """An event's text without the numbers of its run, which stand with the group's first: half of what is stored."""
    said = json.loads(event)
    said["dagster_event"]["logging_tags"] = {}
    made = said["dagster_event"]["event_specific_data"].get("materialization")
    if made:
        made["metadata_entries"] = []
    return json.dumps(said)


def _what(event: EventLogEntry) -> tuple[str, AssetKey]:
    """Run and asset of an asset's event."""
    key = event.get_dagster_event().asset_key
    assert key is not None
    return event.run_id, key


def _dimensions(partition: str | None) -> dict[str, str]:
    along = partition.dimension_keys if isinstance(partition, MultiPartitionKey) else ()
    return {_tag(dimension.dimension_name): dimension.partition_key for dimension in along}


_tag = cache(get_multidimensional_partition_tag)


class CoalescingEventLog(SqlEventLogStorage):
    """An event log in which one event may stand for those that differ in nothing but the partition.

    To be mixed in before one of Dagster's; whoever does says how groups are stored.
    """

    supports_partition_subset_in_asset_materialization_planned_events = True

    def __init__(self, *args: Any, **settings: Any) -> None:
        self._alike: dict[tuple[str, AssetKey], Sequence[str]] = {}
        self._waiting: list[EventLogEntry] = []
        super().__init__(*args, **settings)  # type: ignore[no-untyped-call]

    @abstractmethod
    def _store(self, groups: Sequence[EventGroup]) -> None:
        """Store them, together."""

    @abstractmethod
    def _index(self) -> AbstractContextManager[Connection]:
        """A transaction on the index of all runs."""

    @abstractmethod
    def _written(self, conn: Connection, one: EventGroup) -> int:
        """Id of the group's last row, once it is in the index."""

    def represents(self, run_id: str, asset_key: AssetKey, partitions: Sequence[str]) -> None:
        """Let the run's next materialisation of the asset, that of the first partition, count for all of these."""
        self._alike[run_id, asset_key] = partitions

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
            self._store([self._one(e, self._partitions(e)) for e in due])

    def _mirror(self, groups: Sequence[EventGroup]) -> None:
        """Write the groups into the index with their tags; of each asset the newest of a type counts."""
        newest: dict[tuple[Any, DagsterEventType | None], tuple[EventLogEntry, int]] = {}
        with self._index() as conn:
            for one in groups:
                event_id = self._written(conn, one)
                if one.type in ASSET_EVENTS:
                    newest[one.row["asset_key"], one.type] = one.event, event_id
                elif one.type in ASSET_CHECK_EVENTS:
                    self.store_asset_check_event(one.event, event_id)
            for event, event_id in newest.values():
                self._store_asset_event(conn, event, event_id)

    def _partitions(self, event: EventLogEntry) -> Sequence[str | None]:
        if event.dagster_event_type not in ASSET_EVENTS:
            return [None]
        stands = self._alike.pop(_what(event), None) if event.dagster_event_type == _MADE else None
        return stands or [event.get_dagster_event().partition]

    def _one(self, event: EventLogEntry, partitions: Sequence[str | None]) -> EventGroup:
        if event.dagster_event_type == _PLANNED:
            event = _of(event, partitions[0])  # the run's tags name its range; its keys once more would be 100 kB
        return EventGroup(event, self._event_to_row(event), self._tags_for_asset_event(event), partitions)


def _of(event: EventLogEntry, partition: str | None) -> EventLogEntry:
    """The same plan for one partition, or for the run's."""
    planned = event.get_dagster_event()
    data = AssetMaterializationPlannedData(_what(event)[1], partition)
    return event._replace(dagster_event=planned._replace(event_specific_data=data))
