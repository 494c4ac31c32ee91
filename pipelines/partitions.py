"""Partitions: aircraft x flight below, aircraft above, the fleet on top."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache, wraps
from itertools import product
from typing import Any

import dagster as dg
from dagster._core.definitions.partitions.context import partition_loading_context
from dagster._core.definitions.partitions.subset import PartitionsSubset
from dagster._core.definitions.partitions.utils.multi import PartitionDimensionKey
from dagster._core.execution.context.data_version_cache import DataVersionCache

_standing: list[dict[dg.PartitionKeyRange, Sequence[str]]] = []


@contextmanager
def standing() -> Iterator[None]:
    """While a run is planned and made its range stays as it is, whatever partitions are added elsewhere.

    Dagster asks for the cells of a run's range some fifteen times an asset: within the block they are made once.
    """
    _standing.append({})
    try:
        yield
    finally:
        _standing.pop()


class Cells(dg.MultiPartitionsDefinition):
    """Aircraft x flight, ranges of which stand for a run's length."""

    def get_partition_keys_in_range(
        self,
        partition_key_range: dg.PartitionKeyRange,
        dynamic_partitions_store: dg.DagsterInstance | None = None,
    ) -> Sequence[str]:
        """All cells between two, in both dimensions."""
        known = _standing[-1] if _standing else {}
        if partition_key_range not in known:
            known[partition_key_range] = self._between(partition_key_range, dynamic_partitions_store)
        return known[partition_key_range]

    def _between(
        self, partition_key_range: dg.PartitionKeyRange, dynamic_partitions_store: dg.DagsterInstance | None
    ) -> Sequence[str]:
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
            return list(_product(*along))

    def subset_with_partition_keys(self, partition_keys: Iterable[str]) -> PartitionsSubset:
        """The same for all tables of a run."""
        return _subset(tuple(partition_keys))


AIRCRAFT = dg.DynamicPartitionsDefinition(name="aircraft")
FLIGHTS = dg.DynamicPartitionsDefinition(name="flight")
AIRCRAFT_FLIGHTS = Cells({"aircraft": AIRCRAFT, "flight": FLIGHTS})


@lru_cache(maxsize=2)
def _product(aircraft: tuple[str, ...], flights: tuple[str, ...]) -> tuple[dg.MultiPartitionKey, ...]:
    return tuple(cell_key(a, f) for a, f in product(aircraft, flights))


@lru_cache(maxsize=1)
def _subset(keys: tuple[str, ...]) -> PartitionsSubset:
    return AIRCRAFT_FLIGHTS.empty_subset().with_partition_keys(keys)


class _Uncut:
    """A step's context to which what it reads has no partitions."""

    def __init__(self, context: Any) -> None:
        self._context = context

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    def has_asset_partitions_for_input(self, _: str) -> bool:
        """Of no table."""
        return False


def leave_cells_unlisted() -> None:
    """Let Dagster look up the version of what a step reads without a list of its cells.

    It would make all cells of those aircraft, a hundred thousand keys, for every table, and then leave it, for there
    are more than a hundred. What is stale the ledger says; there is no public way to say so beforehand.
    """
    stock = DataVersionCache.__init__
    if hasattr(stock, "__wrapped__"):
        return

    @wraps(stock)
    def uncut(self: DataVersionCache, context: Any) -> None:
        stock(self, _Uncut(context))

    DataVersionCache.__init__ = uncut


def aircraft_key(operator: str, tail: str) -> str:
    """Partition key of an aircraft."""
    return f"{operator}:{tail}"


def flight_key(flight_id: str) -> str:
    """Partition key of a flight, `YYYYMMDD_LEG`, shared by all aircraft."""
    return flight_id[-11:]


def cell_key(aircraft: str, flight: str) -> dg.MultiPartitionKey:
    """Partition key of an aircraft's flight, of their own keys.

    Dagster's own way to make one checks and sorts, and a run's range is ten thousand of them.
    """
    key = str.__new__(dg.MultiPartitionKey, f"{aircraft}|{flight}")
    key.dimension_keys = [_along("aircraft", aircraft), _along("flight", flight)]
    return key


_along = lru_cache(maxsize=100_000)(PartitionDimensionKey)


def aircraft_of(key: str) -> tuple[str, str]:
    """Operator and tail of an aircraft's key."""
    operator, tail = key.split(":", 1)
    return operator, tail


@lru_cache(maxsize=2)
def cells_of(keys: tuple[str, ...]) -> dict[tuple[str, str, str], str]:
    """Operator, tail and flight id of each of some aircraft x flight keys; all tables of a run have the same."""
    return {_cell_of(key): key for key in keys}


def _cell_of(key: str) -> tuple[str, str, str]:
    aircraft, flight = key.split("|", 1)
    operator, tail = aircraft_of(aircraft)
    return operator, tail, f"{tail}_{flight}"
