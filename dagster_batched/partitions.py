"""Partitions along several dimensions of which a run takes a range of ten thousand cells."""

import gc
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from functools import lru_cache, wraps
from itertools import product
from operator import contains
from typing import Any

import dagster as dg
from dagster._core.definitions.partitions.context import partition_loading_context
from dagster._core.definitions.partitions.subset import PartitionsSubset
from dagster._core.definitions.partitions.utils.multi import PartitionDimensionKey
from dagster._core.execution.context.data_version_cache import DataVersionCache
from dagster._core.instance import DynamicPartitionsStore

_cached: list[dict[dg.PartitionKeyRange, Sequence[Any]]] = []


@contextmanager
def cached_ranges(scattered: Mapping[tuple[str, str], Sequence[str]] | None = None) -> Iterator[None]:
    """While a run is planned and made its range stays as it is, whatever partitions are added elsewhere.

    Dagster asks for the cells of a run's range some fifteen times an asset: within the block they are made once. What a
    range (first, last) is `scattered` to is all of it, and no other cell between: a run may take what lies far apart.
    """
    _cached.append({dg.PartitionKeyRange(*ends): cells for ends, cells in (scattered or {}).items()})
    try:
        yield
    finally:
        _cached.pop()


class RangeKeys(dg.DynamicPartitionsDefinition):
    """Partitions along one dimension, of which a run may take some that are not neighbours."""

    def get_partition_keys_in_range(self, partition_key_range: dg.PartitionKeyRange) -> Sequence[str]:
        """All keys between two, or those that the run was given."""
        found = _cached[-1].get(partition_key_range) if _cached else None
        return found or super().get_partition_keys_in_range(partition_key_range)


class RangePartitions(dg.MultiPartitionsDefinition):
    """Partitions along several dimensions, ranges of which stand for a run's length."""

    def get_partition_keys_in_range(
        self,
        partition_key_range: dg.PartitionKeyRange,
        dynamic_partitions_store: DynamicPartitionsStore | None = None,
    ) -> Sequence[dg.MultiPartitionKey]:
        """All cells between two, in every dimension, or those that the run was given."""
        known = _cached[-1] if _cached else {}
        if partition_key_range not in known:
            known[partition_key_range] = self._between(partition_key_range, dynamic_partitions_store)
        return known[partition_key_range]

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
        """The same for all assets of a run."""
        return _subset(self, tuple(partition_keys))


@lru_cache(maxsize=2)
def _product(dimensions: tuple[str, ...], *along: tuple[str, ...]) -> tuple[dg.MultiPartitionKey, ...]:
    return tuple(multi_keys(dimensions, product(*along)))


@lru_cache(maxsize=1)
def _subset(definition: RangePartitions, keys: tuple[str, ...]) -> PartitionsSubset:
    return definition.empty_subset().with_partition_keys(keys)


def multi_keys(dimensions: Sequence[str], cells: Iterable[tuple[str, ...]]) -> list[dg.MultiPartitionKey]:
    """Partition keys of cells, each a key in each dimension; dimensions in order of their names.

    Dagster's own way to make one checks and sorts, and a run's range is ten thousand of them.
    """
    made = []
    with uncollected():
        for keys in cells:
            key = str.__new__(dg.MultiPartitionKey, "|".join(keys))
            key.dimension_keys = list(map(_along, dimensions, keys))
            made.append(key)
    return made


@contextmanager
def uncollected() -> Iterator[None]:
    """Look for no circles of objects within the block: among ever more keys that takes up to three quarters of it."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


_along = lru_cache(maxsize=100_000)(PartitionDimensionKey)


class _UnpartitionedContext:
    """A step's context to which what it reads has no partitions."""

    def __init__(self, context: Any) -> None:
        self._context = context

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    def has_asset_partitions_for_input(self, _: str) -> bool:
        """Of no asset."""
        return False


def skip_input_versions() -> None:
    """Let Dagster look up the version of what a step reads without a list of its cells.

    It would make all cells of those aircraft, a hundred thousand keys, for every asset, and then leave it, for there
    are more than a hundred. There is no public way to say so beforehand.
    """
    stock = DataVersionCache.__init__
    if hasattr(stock, "__wrapped__"):
        return

    @wraps(stock)
    def unlisted(self: DataVersionCache, context: Any) -> None:
        stock(self, _UnpartitionedContext(context))  # type: ignore[arg-type]

    DataVersionCache.__init__ = unlisted  # type: ignore[method-assign]


def make_keys_quickly() -> None:
    """Let Dagster make a key of each cell that an asset's page counts without checking and sorting its parts.

    The page knows no subclass of Dagster's definition, so the method is replaced in Dagster's own class.
    """
    stock = dg.MultiPartitionsDefinition.filter_valid_partition_keys
    if not hasattr(stock, "__wrapped__"):
        dg.MultiPartitionsDefinition.filter_valid_partition_keys = wraps(stock)(valid_keys)  # type: ignore[method-assign]


@uncollected()
def valid_keys(self: dg.MultiPartitionsDefinition, partition_keys: Iterable[str]) -> set[dg.MultiPartitionKey]:
    """Of some keys those whose parts are keys of the dimensions, as Dagster finds them."""
    dimensions = self.partitions_defs
    parted = [parts for key in partition_keys if len(parts := tuple(key.split("|"))) == len(dimensions)]
    valid = [
        _known(dimension.partitions_def, set(parts))
        for dimension, parts in zip(dimensions, zip(*parted, strict=True), strict=False)  # no parts of no keys
    ]
    names = [dimension.name for dimension in dimensions]
    return set(multi_keys(names, (parts for parts in parted if all(map(contains, valid, parts)))))


def _known(definition: dg.PartitionsDefinition[str], keys: set[str]) -> Set[str]:
    """Of some keys those that the definition knows; Dagster 1.12 can't ask storage for these alone."""
    ask = getattr(definition, "filter_valid_partition_keys", None)
    return ask(keys) if ask else keys.intersection(definition.get_partition_keys())
