"""Events that differ in their partition, its numbers and by milliseconds, held as the first and what differs.

Stock makes and serialises an event of 2 kB for every partition of a step: here one is made, and its text, less what it
tells of the run, serves the others.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from json.encoder import encode_basestring_ascii as _quoted
from typing import Any, NamedTuple

from dagster import MultiPartitionKey
from dagster._core.events.log import EventLogEntry
from dagster._core.storage.tags import get_multidimensional_partition_tag

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

    def others(self) -> Iterator[Other]:
        """All but the first, each a millisecond after the one before it."""
        if len(self.partitions) < 2:
            return
        pattern, at_s = self._pattern(), self.event.timestamp
        for i, partition in enumerate(self.partitions[1:], 1):
            if partition:
                own, then_s = _dimensions(partition), at_s + i * APART_S
                told = {key: _quoted(value) for key, value in own.items()} | {
                    "partition": _quoted(partition), "timestamp": repr(then_s), _NUMBERS: self._numbers(i)
                }  # fmt: skip
                yield Other(partition, pattern % told, self.tags and {**self.tags, **own}, _moment(then_s))

    def _pattern(self) -> str:
        """Text of the first with a place for what differs."""
        said = _bare(str(self.row["event"]))
        names = {"partition": json.dumps(self.row["partition"]), "timestamp": json.dumps(said["timestamp"])}
        names |= {key: json.dumps(value) for key, value in _dimensions(self.row["partition"]).items()}
        told = json.dumps(said, separators=(",", ":"))
        pattern = told.replace("%", "%%").replace(f'"{_NUMBERS}"', f"[%({_NUMBERS})s]")
        for key, value in names.items():
            pattern = pattern.replace(f'"{key}":{value}', f'"{key}":%({key})s')
        return pattern

    def _numbers(self, place: int) -> str:
        own = self.numbers[place] if self.numbers else {}
        return ",".join(_ENTRY % (_quoted(label), value) for label, value in own.items())


_NUMBERS = "numbers"
_ENTRY = '{"__class__":"EventMetadataEntry","label":%s,"entry_data":{"__class__":"IntMetadataEntryData","value":%d}}'
_WITH_THE_FIRST = ("step_handle", "solid_handle", "message", "logging_tags", "pid", "step_kind_value")
"""Of a run's event, what Dagster takes for none where it is not told: the step's key stands beside it once more."""


def _moment(timestamp_s: float) -> datetime:
    """As Dagster's tables hold it: UTC, without a zone."""
    return datetime.fromtimestamp(timestamp_s, UTC).replace(tzinfo=None)


def _bare(event: str) -> dict[str, Any]:
    """An event without what stands with the group's first, the numbers of its run above all: half of what is stored."""
    said: dict[str, Any] = json.loads(event)
    said["dagster_event"] = {k: v for k, v in said["dagster_event"].items() if k not in _WITH_THE_FIRST}
    made = said["dagster_event"]["event_specific_data"].get("materialization")
    if made:
        made["metadata_entries"] = _NUMBERS
        said["dagster_event"]["event_specific_data"] = {
            "__class__": "StepMaterializationData",
            "materialization": {k: v for k, v in made.items() if v is not None},
        }
    return said


def _dimensions(partition: str | None) -> dict[str, str]:
    along = partition.dimension_keys if isinstance(partition, MultiPartitionKey) else ()
    return {_tag(dimension.dimension_name): dimension.partition_key for dimension in along}


_tag = cache(get_multidimensional_partition_tag)
