"""Define the partitions (aircraft and flight, aircraft, fleet) and the cells of a run."""

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
from pipelines.versions import CELL, expected_versions, restrict_ledger

AIRCRAFT = RangeKeys(name="aircraft")
FLIGHTS = dg.DynamicPartitionsDefinition(name="flight")
AIRCRAFT_FLIGHTS = RangePartitions({"aircraft": AIRCRAFT, "flight": FLIGHTS})
NIGHT = {"hdt/night": "yes"}
"""Tag of a run of the chain, which takes cells with files; a run from Dagster's page may take any."""


def aircraft_key(operator: str, tail: str) -> str:
    """Format the partition key of an aircraft."""
    return f"{operator}:{tail}"


def flight_key(flight_id: str) -> str:
    """Format the partition key of a flight, `YYYYMMDD_LEG`, shared by all aircraft."""
    return flight_id[-11:]


def cell_keys(cells: Iterable[tuple[str, str]]) -> list[dg.MultiPartitionKey]:
    """Combine keys of aircraft and flights into partition keys."""
    return multi_keys(("aircraft", "flight"), cells)


def aircraft_of(key: str) -> tuple[str, str]:
    """Split an aircraft's key into operator and tail."""
    operator, tail = key.split(":", 1)
    return operator, tail


@lru_cache(maxsize=2)
def cells_of(keys: tuple[str, ...]) -> dict[tuple[str, str, str], str]:
    """Map cells (operator, tail, flight id, empty above flights) to their keys; the same for all tables of a run."""
    return {_cell_of(key): key for key in keys}


def _cell_of(key: str) -> tuple[str, str, str]:
    aircraft, _, flight = key.partition("|")
    operator, tail = aircraft_of(aircraft)
    return operator, tail, f"{tail}_{flight}" if flight else ""


@dataclass(frozen=True)
class PartitionScope:
    """Cells of a run: None for the whole fleet, else aircraft and, by flight, the flights of each."""

    aircraft: dict[tuple[str, str], list[str]] | None

    @classmethod
    def of(cls, keys: list[str] | None) -> "PartitionScope":
        """Build a scope from partition keys, of aircraft or of aircraft and flight."""
        if keys is None:
            return cls(None)
        if "|" not in keys[0]:
            return cls({aircraft_of(key): [] for key in keys})
        aircraft: dict[tuple[str, str], list[str]] = {}
        for operator, tail, flight in cells_of(tuple(keys)):
            aircraft.setdefault((operator, tail), []).append(flight)
        return cls(aircraft)

    def cells(self) -> pl.DataFrame:
        """List the cells: operator, tail, flight_id (empty above flights)."""
        rows = [(o, t, f) for (o, t), flights in (self.aircraft or {FLEET: []}).items() for f in flights or [""]]
        return pl.DataFrame(rows, schema=dict.fromkeys(CELL, pl.String), orient="row")

    def expected_cells(self, ledger: Ledger, table: str) -> pl.DataFrame:
        """List the cells of the run that `table` should have, each with its expected version."""
        if self.aircraft is None:
            return expected_versions(ledger, table).join(self.cells(), on=CELL, how="semi")
        flights = {f for ids in self.aircraft.values() for f in ids}
        own = restrict_ledger(ledger, MAKER[table], self.aircraft, flights)
        return expected_versions(own, table).join(self.cells(), on=CELL, how="semi")

    def read_table(self, store: Store, table: str) -> pl.DataFrame:
        """Read the rows of `table` of the run's aircraft, and of its flights where both are by flight."""
        if self.aircraft is None or TABLES[table].grain == "fleet":
            return store.read_table(table)
        flights = [f for ids in self.aircraft.values() for f in ids]
        if not flights or TABLES[table].grain != "flight":
            return store.read_table(table, self.aircraft)
        rows = store.scan(table, self.aircraft, flights).filter(pl.col("flight_id").is_in(flights)).collect()
        # two operators may fly one registration on one day, and the run have only one of the flights
        return rows.join(self.cells(), on=CELL, how="semi", maintain_order="left")
