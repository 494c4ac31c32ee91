"""Hold events that differ only in partition, numbers and milliseconds as the first one and the differences.

Stock makes and serialises an event of 2 kB for every partition of a step: here one is made, and its text without the
run's details serves the others.
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
"""Time between two partitions' events: Dagster's pages show milliseconds, and identify events by their times."""


class Other(NamedTuple):
    """An event of a group beside its first: partition, Dagster's own text, tags, time."""

    partition: str
    event: str
    tags: Mapping[str, str]
    at: datetime


@dataclass(frozen=True, slots=True)
class EventGroup:
    """Events that differ only in partition, numbers and milliseconds.

    `event` and `row` are those of the first; `partitions` and a materialisation's `numbers` those of all.
    """

    event: EventLogEntry
    row: dict[str, Any]
    tags: Mapping[str, str]
    partitions: Sequence[str | None]
    numbers: Sequence[Mapping[str, int]] = ()

    def others(self) -> Iterator[Other]:
        """Yield all but the first, each a millisecond after the one before it."""
        if len(self.partitions) < 2:
            return
        pattern, at_s = self._pattern(), self.event.timestamp
        for i, partition in enumerate(self.partitions[1:], 1):
            if partition:
                own, then_s = _dimensions(partition), at_s + i * APART_S
                values = {key: _quoted(value) for key, value in own.items()} | {
                    "partition": _quoted(partition), "timestamp": repr(then_s), _NUMBERS: self._numbers(i)
                }  # fmt: skip
                yield Other(partition, pattern % values, self.tags and {**self.tags, **own}, _table_time(then_s))

    def _pattern(self) -> str:
        """Turn the first event's text into a template for the others."""
        content = _without_details(str(self.row["event"]))
        names = {"partition": json.dumps(self.row["partition"]), "timestamp": json.dumps(content["timestamp"])}
        names |= {key: json.dumps(value) for key, value in _dimensions(self.row["partition"]).items()}
        text = json.dumps(content, separators=(",", ":"))
        pattern = text.replace("%", "%%").replace(f'"{_NUMBERS}"', f"[%({_NUMBERS})s]")
        for key, value in names.items():
            pattern = pattern.replace(f'"{key}":{value}', f'"{key}":%({key})s')
        return pattern

    def _numbers(self, place: int) -> str:
        own = self.numbers[place] if self.numbers else {}
        return ",".join(_ENTRY % (_quoted(label), value) for label, value in own.items())


_NUMBERS = "numbers"
_ENTRY = '{"__class__":"EventMetadataEntry","label":%s,"entry_data":{"__class__":"IntMetadataEntryData","value":%d}}'
_FIRST_ONLY = ("step_handle", "solid_handle", "message", "logging_tags", "pid", "step_kind_value")
"""Fields of an event that Dagster accepts as missing; the step's key is in the row too."""


def _table_time(timestamp_s: float) -> datetime:
    """Convert to the time in Dagster's tables: UTC, without a zone."""
    return datetime.fromtimestamp(timestamp_s, UTC).replace(tzinfo=None)


def _without_details(event: str) -> dict[str, Any]:
    """Drop what the group's first event holds for all, above all the numbers of its run: half of its size."""
    content: dict[str, Any] = json.loads(event)
    content["dagster_event"] = {k: v for k, v in content["dagster_event"].items() if k not in _FIRST_ONLY}
    materialization = content["dagster_event"]["event_specific_data"].get("materialization")
    if materialization:
        materialization["metadata_entries"] = _NUMBERS
        content["dagster_event"]["event_specific_data"] = {
            "__class__": "StepMaterializationData",
            "materialization": {k: v for k, v in materialization.items() if v is not None},
        }
    return content


def _dimensions(partition: str | None) -> dict[str, str]:
    along = partition.dimension_keys if isinstance(partition, MultiPartitionKey) else ()
    return {_tag(dimension.dimension_name): dimension.partition_key for dimension in along}


_tag = cache(get_multidimensional_partition_tag)
