"""Partitions: aircraft x flight below, aircraft above, the fleet on top."""

from collections.abc import Sequence
from functools import lru_cache
from itertools import product

import dagster as dg
from dagster._core.definitions.partitions.context import partition_loading_context


class Cells(dg.MultiPartitionsDefinition):
    """Aircraft x flight. Dagster asks for the cells of a run's range some fifteen times an asset: made once here."""

    def get_partition_keys_in_range(
        self,
        partition_key_range: dg.PartitionKeyRange,
        dynamic_partitions_store: dg.DagsterInstance | None = None,
    ) -> Sequence[str]:
        """All cells between two, in both dimensions."""
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


AIRCRAFT = dg.DynamicPartitionsDefinition(name="aircraft")
FLIGHTS = dg.DynamicPartitionsDefinition(name="flight")
AIRCRAFT_FLIGHTS = Cells({"aircraft": AIRCRAFT, "flight": FLIGHTS})


@lru_cache(maxsize=2)
def _product(aircraft: tuple[str, ...], flights: tuple[str, ...]) -> tuple[dg.MultiPartitionKey, ...]:
    return tuple(cell_key(a, f) for a, f in product(aircraft, flights))


def aircraft_key(operator: str, tail: str) -> str:
    """Partition key of an aircraft."""
    return f"{operator}:{tail}"


def flight_key(flight_id: str) -> str:
    """Partition key of a flight, `YYYYMMDD_LEG`, shared by all aircraft."""
    return flight_id[-11:]


def cell_key(aircraft: str, flight: str) -> dg.MultiPartitionKey:
    """Partition key of an aircraft's flight, of their own keys."""
    return dg.MultiPartitionKey({"aircraft": aircraft, "flight": flight})


def aircraft_of(key: str) -> tuple[str, str]:
    """Operator and tail of an aircraft's key."""
    operator, tail = key.split(":", 1)
    return operator, tail


def cell_of(key: str) -> tuple[str, str, str]:
    """Operator, tail and flight id of an aircraft x flight key."""
    aircraft, flight = key.split("|", 1)
    operator, tail = aircraft_of(aircraft)
    return operator, tail, f"{tail}_{flight}"
