"""Group cells into runs: up to `CELLS_A_RUN` flights of one or several aircraft."""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from operator import itemgetter

import polars as pl

from dagster_batched.runs import range_tags
from pipelines.resources import aircraft_key, cell_keys, flight_key

CELLS_A_RUN = 1_000  # flights a run that reads files takes at most: memory grows neither with the fleet nor its history
Cell = tuple[str, str]
"""Keys of an aircraft and of one of its flights, which is empty above flights."""


@dataclass(frozen=True, slots=True)
class PartitionBatch:
    """Cells of one run, in the order of their partitions; no cells for a table of the whole fleet."""

    cells: tuple[Cell, ...] = ()
    flights: tuple[str, str] = ("", "")

    @property
    def aircraft(self) -> list[str]:
        """Keys of the aircraft."""
        return list(dict.fromkeys(map(itemgetter(0), self.cells)))

    @property
    def size(self) -> int:
        """Number of cells."""
        return len(self.cells) or 1

    @property
    def label(self) -> str:
        """First aircraft, or `fleet`."""
        return self.cells[0][0] if self.cells else "fleet"

    def partition_keys(self) -> Sequence[str]:
        """Return Dagster's partition keys."""
        return cell_keys(self.cells) if self.flights[0] else self.aircraft

    def parts(self) -> list["PartitionBatch"]:
        """Split into runs of one aircraft each or, of one aircraft, into halves; none where there is one cell."""
        cell_groups = [tuple(cells) for _, cells in groupby(self.cells, key=itemgetter(0))]
        if len(cell_groups) == 1:
            half = len(self.cells) // 2
            cell_groups = [self.cells[:half], self.cells[half:]] if half else []
        return [PartitionBatch(cells, (cells[0][1], cells[-1][1])) for cells in cell_groups]

    def tags(self) -> dict[str, str]:
        """Return Dagster's range tags, with the aircraft or operator by which its runs can be searched."""
        aircraft = self.aircraft
        if not aircraft:
            return {}
        tags = {"hdt/aircraft": aircraft[0]} if len(aircraft) == 1 else {}
        operators = {a.split(":")[0] for a in aircraft}
        tags |= {"hdt/operator": operators.pop()} if len(operators) == 1 else {}
        return range_tags(*self.ends()) | tags

    def ends(self) -> Cell:
        """Return partition keys of the first and last cell of the enclosing range."""
        sides = zip((self.cells[0][0], self.cells[-1][0]), self.flights, strict=True)
        first, last = (f"{aircraft}|{flight}" if flight else aircraft for aircraft, flight in sides)
        return first, last


@dataclass(frozen=True, slots=True)
class BatchResult:
    """Outcome of a batch: cells, runs, failures with reasons, and runs that succeeded only in parts."""

    cells: int
    runs: int
    failed: dict[str, str] = field(default_factory=dict)
    repairs: tuple[str, ...] = ()


def split_message(label: str, batch: PartitionBatch, failure: str) -> tuple[str, ...]:
    """Describe a run that failed although its parts succeeded, so that the failure is still reported."""
    scope = (
        f"{len(batch.aircraft)} aircraft stopped, so each"
        if len(batch.aircraft) > 1
        else "1 aircraft stopped, so each part"
    )
    return (f"{label}: a run of {scope} was made alone; report it: {failure}",)


@dataclass(frozen=True, slots=True)
class PartitionIndex:
    """Partition keys in Dagster's order, and the flights of each aircraft."""

    aircraft: list[str]
    flights: list[str]
    flights_of: dict[str, set[str]]

    def batches(
        self, grain: str, cells: pl.DataFrame, batch_factor: int = 1, n_processes: int = 1, *, ranges: bool = False
    ) -> Iterator[PartitionBatch]:
        """Yield runs of the cells (operator, tail, flight_id), up to `batch_factor` times `CELLS_A_RUN` flights each.

        Runs are spread evenly over `n_processes`, by whole aircraft. With `ranges` each covers all flights between its
        ends, for another machine receives only these.
        """
        if grain == "fleet":
            return iter([PartitionBatch()])
        stretches_of = self._aircraft if grain == "aircraft" else self._flights
        max_flights = batch_factor * CELLS_A_RUN
        flights = self.count(grain, cells)
        runs = n_processes * max(1, math.ceil(flights / (n_processes * max_flights)))
        share = math.ceil(flights / runs)
        stretches = stretches_of(by_aircraft(cells), min(max_flights, share))
        return self._merge_stretches(stretches, max_flights, share, ranges)

    def count(self, grain: str, cells: pl.DataFrame) -> int:
        """Count flights of the cells; of a cell of an aircraft, all its flights."""
        if grain == "flight":
            return cells.height
        return sum(len(self.flights_of.get(aircraft, ())) for aircraft in by_aircraft(cells))

    def _merge_stretches(
        self, stretches: Iterator[list[Cell]], max_flights: int, share: int, ranges: bool
    ) -> Iterator[PartitionBatch]:
        """Merge stretches while a run stays within `max_flights` and near its share."""
        place = {key: i for i, key in enumerate(self.flights)}
        aircraft = self.aircraft if ranges else []
        positions = [sorted(place[f] for f in self.flights_of.get(a, ()) if f in place) for a in aircraft]
        pending = list[Cell]()
        size = 0
        for stretch in stretches:
            n_flights = len(stretch) if stretch[0][1] else len(self.flights_of.get(stretch[0][0], ()))
            full = size + n_flights > max_flights or size + n_flights / 2 > share
            if pending and (full or (ranges and not self._is_range([*pending, *stretch], positions, place))):
                yield _batch(pending, place)
                pending = []
                size = 0
            pending = pending + stretch
            size = size + n_flights
        if pending:
            yield _batch(pending, place)

    def _aircraft(self, cells: dict[str, set[str]], max_flights: int) -> Iterator[list[Cell]]:
        return ([(a, "")] for a in self.aircraft if a in cells)

    def _flights(self, cells: dict[str, set[str]], max_flights: int) -> Iterator[list[Cell]]:
        """Yield each aircraft's stretches of consecutive wanted flights, none longer than `max_flights`."""
        place = {key: i for i, key in enumerate(self.flights)}
        for a in (a for a in self.aircraft if a in cells):
            flights = sorted((f for f in self.flights_of.get(a, ()) if f in place), key=place.__getitem__)
            for is_selected, run in groupby(flights, key=cells[a].__contains__):
                stretch = [(a, f) for f in run if is_selected]
                yield from (stretch[i : i + max_flights] for i in range(0, len(stretch), max_flights))

    def _is_range(self, cells: list[Cell], positions: list[list[int]], place: dict[str, int]) -> bool:
        """Check that the cells are all flights from the first cell to the last."""
        first = self.aircraft.index(cells[0][0])
        last = self.aircraft.index(cells[-1][0])
        if not cells[0][1]:
            return last - first == len(cells) - 1
        at = [place[f] for _, f in cells]
        between = (bisect_right(p, max(at)) - bisect_left(p, min(at)) for p in positions[first : last + 1])
        return sum(between) == len(cells)


def _batch(cells: list[Cell], place: dict[str, int]) -> PartitionBatch:
    """Build a batch; its ends follow the partitions' order, in which a late flight comes after younger ones."""
    flights = [f for _, f in cells if f]
    at = place.__getitem__
    return PartitionBatch(tuple(cells), (min(flights, key=at), max(flights, key=at)) if flights else ("", ""))


def by_aircraft(cells: pl.DataFrame) -> dict[str, set[str]]:
    """Group flight keys by aircraft key, from operator, tail and flight_id (empty above flights)."""
    flights: dict[str, set[str]] = {}
    for o, t, f in cells.select("operator", "tail", "flight_id").rows():
        flights.setdefault(aircraft_key(o, t), set()).add(flight_key(t, f))
    return flights
