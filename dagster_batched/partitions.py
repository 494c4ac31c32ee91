"""Define partitions of which a run takes a range of ten thousand cells, and group events that differ only in them.

Stock makes and serialises an event of 2 kB for every partition of a step: here one is made, and its text without the
run's details serves the others.
"""

import gc
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache, lru_cache, wraps
from itertools import product
from json.encoder import encode_basestring_ascii as _quoted
from operator import contains
from typing import Any, NamedTuple

import dagster as dg
from dagster import MultiPartitionKey
from dagster._core.definitions.partitions.context import partition_loading_context
from dagster._core.definitions.partitions.subset import PartitionsSubset
from dagster._core.definitions.partitions.utils.multi import PartitionDimensionKey
from dagster._core.events.log import EventLogEntry
from dagster._core.execution.context.data_version_cache import DataVersionCache
from dagster._core.instance import DynamicPartitionsStore
from dagster._core.storage.tags import get_multidimensional_partition_tag

_ranges: list[dict[dg.PartitionKeyRange, Sequence[Any]]] = []


@contextmanager
def cached_ranges(cells_of_range: Mapping[tuple[str, str], Sequence[str]] | None = None) -> Iterator[None]:
    """Fix the cells of a run's range while it is planned and executed, whatever partitions are added elsewhere.

    Dagster requests the cells of a run's range some fifteen times an asset: within the block they are computed once. A
    range (first, last) in `cells_of_range` has those cells and none between: a run may take cells that are far apart.
    """
    _ranges.append({dg.PartitionKeyRange(*bounds): cells for bounds, cells in (cells_of_range or {}).items()})
    try:
        yield
    finally:
        _ranges.pop()


class RangeKeys(dg.DynamicPartitionsDefinition):
    """Partitions along one dimension, of which a run may take some that are not adjacent."""

    def get_partition_keys_in_range(self, partition_key_range: dg.PartitionKeyRange) -> Sequence[str]:
        """List the keys between two, or those that were set for the run."""
        keys = _ranges[-1].get(partition_key_range) if _ranges else None
        return keys or super().get_partition_keys_in_range(partition_key_range)


class RangePartitions(dg.MultiPartitionsDefinition):
    """Partitions along several dimensions whose ranges are fixed during a run."""

    def get_partition_keys_in_range(
        self,
        partition_key_range: dg.PartitionKeyRange,
        dynamic_partitions_store: DynamicPartitionsStore | None = None,
    ) -> Sequence[dg.MultiPartitionKey]:
        """List the cells between two, in every dimension, or those that were set for the run."""
        ranges = _ranges[-1] if _ranges else {}
        if partition_key_range not in ranges:
            ranges[partition_key_range] = self._between(partition_key_range, dynamic_partitions_store)
        return ranges[partition_key_range]

    def _between(
        self, partition_key_range: dg.PartitionKeyRange, dynamic_partitions_store: DynamicPartitionsStore | None
    ) -> Sequence[dg.MultiPartitionKey]:
        first, last = (self.get_partition_key_from_str(key) for key in partition_key_range)
        with partition_loading_context(dynamic_partitions_store=dynamic_partitions_store):
            ranges = [
                dg.PartitionKeyRange(first.keys_by_dimension[d.name], last.keys_by_dimension[d.name])
                for d in self.partitions_defs
            ]
            along = (
                tuple(d.partitions_def.get_partition_keys_in_range(r))
                for d, r in zip(self.partitions_defs, ranges, strict=True)
            )
            return list(_product(tuple(d.name for d in self.partitions_defs), *along))

    def subset_with_partition_keys(self, partition_keys: Iterable[str]) -> PartitionsSubset:
        """Build the subset, once for all assets of a run."""
        return _subset(self, tuple(partition_keys))


@lru_cache(maxsize=2)
def _product(dimensions: tuple[str, ...], *along: tuple[str, ...]) -> tuple[dg.MultiPartitionKey, ...]:
    return tuple(multi_keys(dimensions, product(*along)))


@lru_cache(maxsize=1)
def _subset(definition: RangePartitions, keys: tuple[str, ...]) -> PartitionsSubset:
    return definition.empty_subset().with_partition_keys(keys)


def multi_keys(dimensions: Sequence[str], cells: Iterable[tuple[str, ...]]) -> list[dg.MultiPartitionKey]:
    """Make partition keys of cells, each a key in each dimension; dimensions in order of their names.

    Dagster's own constructor checks and sorts, and a run's range has ten thousand keys.
    """
    result = []
    with without_garbage_collection():
        for keys in cells:
            key = str.__new__(dg.MultiPartitionKey, "|".join(keys))
            key.dimension_keys = list(map(_along, dimensions, keys))
            result.append(key)
    return result


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Switch the garbage collector off within the block: it would take up to three quarters of the time."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


_along = lru_cache(maxsize=100_000)(PartitionDimensionKey)


class _UnpartitionedContext:
    """A step's context without partitions of its inputs."""

    def __init__(self, context: Any) -> None:
        self._context = context

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    def has_asset_partitions_for_input(self, _: str) -> bool:
        """Return False for every asset."""
        return False


def skip_input_versions() -> None:
    """Have Dagster look up the version of a step's inputs without listing their cells.

    It would make a hundred thousand keys for every asset, and then give up, since there are more than a hundred. There
    is no public way to prevent that.
    """
    stock = DataVersionCache.__init__
    if hasattr(stock, "__wrapped__"):
        return

    @wraps(stock)
    def init_without_cells(self: DataVersionCache, context: Any) -> None:
        stock(self, _UnpartitionedContext(context))  # type: ignore[arg-type]

    DataVersionCache.__init__ = init_without_cells  # type: ignore[method-assign]


def make_keys_quickly() -> None:
    """Have Dagster make the keys that an asset's page counts without checking and sorting their parts.

    The page ignores subclasses of Dagster's definition, so the method is replaced in Dagster's own class.
    """
    stock = dg.MultiPartitionsDefinition.filter_valid_partition_keys
    if not hasattr(stock, "__wrapped__"):
        dg.MultiPartitionsDefinition.filter_valid_partition_keys = wraps(stock)(valid_keys)  # type: ignore[method-assign]


@without_garbage_collection()
def valid_keys(self: dg.MultiPartitionsDefinition, partition_keys: Iterable[str]) -> set[dg.MultiPartitionKey]:
    """Select keys whose parts are keys of the dimensions, as Dagster does."""
    dimensions = self.partitions_defs
    split_keys = [parts for key in partition_keys if len(parts := tuple(key.split("|"))) == len(dimensions)]
    valid = [
        _existing_keys(dimension.partitions_def, set(parts))
        for dimension, parts in zip(dimensions, zip(*split_keys, strict=True), strict=False)  # no parts of no keys
    ]
    names = [dimension.name for dimension in dimensions]
    return set(multi_keys(names, (parts for parts in split_keys if all(map(contains, valid, parts)))))


def _existing_keys(definition: dg.PartitionsDefinition[str], keys: set[str]) -> Set[str]:
    """Select keys that the definition has; Dagster 1.12 can't query storage for these alone."""
    query = getattr(definition, "filter_valid_partition_keys", None)
    return query(keys) if query else keys.intersection(definition.get_partition_keys())


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
        pattern = self._pattern()
        at_s = self.event.timestamp
        for i, partition in enumerate(self.partitions[1:], 1):
            if partition:
                own = _dimensions(partition)
                then_s = at_s + i * APART_S
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
