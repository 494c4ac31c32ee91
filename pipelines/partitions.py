"""Partitions: aircraft x flight below, aircraft above, the fleet on top; and what of them a run is asked to make."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import dagster as dg
import polars as pl

from dagster_batched.partitions import RangeKeys, RangePartitions, multi_keys
from hdt_core.tables import TABLES
from pipelines.lineage import MAKER
from pipelines.storage.ledger import Ledger
from pipelines.storage.store import FLEET, Store
from pipelines.versions import CELL, expected, narrowed

AIRCRAFT = RangeKeys(name="aircraft")
FLIGHTS = dg.DynamicPartitionsDefinition(name="flight")
AIRCRAFT_FLIGHTS = RangePartitions({"aircraft": AIRCRAFT, "flight": FLIGHTS})
NIGHT = {"hdt/night": "yes"}
"""Tag of a run of the chain, which takes cells that files fill; who starts one from the page may ask for any."""


def aircraft_key(operator: str, tail: str) -> str:
    """Partition key of an aircraft."""
    return f"{operator}:{tail}"


def flight_key(flight_id: str) -> str:
    """Partition key of a flight, `YYYYMMDD_LEG`, shared by all aircraft."""
    return flight_id[-11:]


def cell_keys(cells: Iterable[tuple[str, str]]) -> list[dg.MultiPartitionKey]:
    """Partition keys of flights of aircraft, of the keys of both."""
    return multi_keys(("aircraft", "flight"), cells)


def aircraft_of(key: str) -> tuple[str, str]:
    """Operator and tail of an aircraft's key."""
    operator, tail = key.split(":", 1)
    return operator, tail


@lru_cache(maxsize=2)
def cells_of(keys: tuple[str, ...]) -> dict[tuple[str, str, str], str]:
    """Operator, tail and flight id, empty above flights, of each of some keys; all tables of a run have the same."""
    return {_cell_of(key): key for key in keys}


def _cell_of(key: str) -> tuple[str, str, str]:
    aircraft, _, flight = key.partition("|")
    operator, tail = aircraft_of(aircraft)
    return operator, tail, f"{tail}_{flight}" if flight else ""


@dataclass(frozen=True)
class PartitionScope:
    """What a run is asked to make: None for the whole fleet, else aircraft and, by flight, the flights of each."""

    aircraft: dict[tuple[str, str], list[str]] | None

    @classmethod
    def of(cls, keys: list[str] | None) -> "PartitionScope":
        """From partition keys, of aircraft or of aircraft and flight."""
        if keys is None:
            return cls(None)
        if "|" not in keys[0]:
            return cls({aircraft_of(key): [] for key in keys})
        aircraft: dict[tuple[str, str], list[str]] = {}
        for operator, tail, flight in cells_of(tuple(keys)):
            aircraft.setdefault((operator, tail), []).append(flight)
        return cls(aircraft)

    def cells(self) -> pl.DataFrame:
        """The cells asked for: operator, tail, flight_id (empty above flights)."""
        rows = [(o, t, f) for (o, t), flights in (self.aircraft or {FLEET: []}).items() for f in flights or [""]]
        return pl.DataFrame(rows, schema=dict.fromkeys(CELL, pl.String), orient="row")

    def due(self, ledger: Ledger, table: str) -> pl.DataFrame:
        """The cells that `table` should have, of those asked for, each with the version it should be."""
        if self.aircraft is None:
            return expected(ledger, table).join(self.cells(), on=CELL, how="semi")
        flights = {f for asked in self.aircraft.values() for f in asked}
        own = narrowed(ledger, MAKER[table], self.aircraft, flights)
        return expected(own, table).join(self.cells(), on=CELL, how="semi")

    def read(self, store: Store, table: str) -> pl.DataFrame:
        """What `table` holds for the aircraft, and the flights where both are by flight, that are asked for."""
        if self.aircraft is None or TABLES[table].grain == "fleet":
            return store.read(table)
        flights = [f for asked in self.aircraft.values() for f in asked]
        if not flights or TABLES[table].grain != "flight":
            return store.read(table, self.aircraft)
        rows = store.scan(table, self.aircraft, flights).filter(pl.col("flight_id").is_in(flights)).collect()
        # two operators may fly one registration on one day, and only one of the flights be asked for
        return rows.join(self.cells(), on=CELL, how="semi", maintain_order="left")
