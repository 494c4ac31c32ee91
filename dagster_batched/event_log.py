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
from datetime import UTC, datetime
from functools import cache
from json.encoder import encode_basestring_ascii as _quoted
from typing import Any, NamedTuple

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


APART_S = 0.001
"""From one partition's event to the next: Dagster's pages tell times by the millisecond, and events by their times."""


class Other(NamedTuple):
    """An event of a group beside its first: partition, Dagster's own text, tags, when it is said to have happened."""

    partition: str
    event: str
    tags: Mapping[str, str]
    at: datetime


@dataclass(frozen=True, slots=True)
class EventGroup:
    """Events that differ in their partition, its numbers and by milliseconds.

    Held are the first as it was handed over, its row, and of all the partitions and, of a materialisation, numbers.
    """

    event: EventLogEntry
    row: dict[str, Any]
    tags: Mapping[str, str]
    partitions: Sequence[str | None]
    numbers: Sequence[Mapping[str, int]] = ()

    @property
    def type(self) -> DagsterEventType | None:
        """Of the events; None for a line of a log."""
        return self.event.dagster_event_type

    @property
    def crosses_runs(self) -> bool:
        """Whether it belongs into the index of all runs."""
        return self.type in ASSET_EVENTS | ASSET_CHECK_EVENTS or self.type in EVENT_TYPE_TO_PIPELINE_RUN_STATUS

    def others(self) -> Iterator[Other]:
        """All but the first, each a millisecond before the one before it."""
        if len(self.partitions) < 2:
            return
        pattern, at_s = self._pattern(), self.event.timestamp
        for i, partition in enumerate(self.partitions[1:], 1):
            if partition:
                own, then_s = _dimensions(partition), at_s - i * APART_S
                told = {key: _quoted(value) for key, value in own.items()} | {
                    "partition": _quoted(partition), "timestamp": repr(then_s), _NUMBERS: self._numbers(i)
                }  # fmt: skip
                yield Other(partition, pattern % told, self.tags and {**self.tags, **own}, _moment(then_s))

    def _pattern(self) -> str:
        """Text of the first with a place for what differs."""
        said = _bare(str(self.row["event"]))
        names = {"partition": json.dumps(self.row["partition"]), "timestamp": json.dumps(said["timestamp"])}
        names |= {key: json.dumps(value) for key, value in _dimensions(self.row["partition"]).items()}
        pattern = json.dumps(said).replace("%", "%%").replace(f'"{_NUMBERS}"', f"[%({_NUMBERS})s]")
        for key, value in names.items():
            pattern = pattern.replace(f'"{key}": {value}', f'"{key}": %({key})s')
        return pattern

    def _numbers(self, place: int) -> str:
        own = self.numbers[place] if self.numbers else {}
        return ", ".join(_ENTRY % (_quoted(label), value) for label, value in own.items())


_NUMBERS = "numbers"
_ENTRY = (
    '{"__class__": "EventMetadataEntry", "label": %s, "description": null, '
    '"entry_data": {"__class__": "IntMetadataEntryData", "value": %d}}'
)


def _moment(timestamp_s: float) -> datetime:
    """As Dagster's tables hold it: UTC, without a zone."""
    return datetime.fromtimestamp(timestamp_s, UTC).replace(tzinfo=None)


def _bare(event: str) -> dict[str, Any]:
    """An event without the numbers of its run, which stand with the group's first: half of what is stored."""
    said: dict[str, Any] = json.loads(event)
    said["dagster_event"]["logging_tags"] = {}
    made = said["dagster_event"]["event_specific_data"].get("materialization")
    if made:
        made["metadata_entries"] = _NUMBERS
    return said


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
        self._alike: dict[tuple[str, AssetKey], tuple[Sequence[str], Sequence[Mapping[str, int]]]] = {}
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


def _of(event: EventLogEntry, partition: str | None) -> EventLogEntry:
    """The same plan for one partition, or for the run's."""
    planned = event.get_dagster_event()
    data = AssetMaterializationPlannedData(_what(event)[1], partition)
    return event._replace(dagster_event=planned._replace(event_specific_data=data))
