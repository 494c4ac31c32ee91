"""Which cells share a run: as many flights as one may hold, of one or several aircraft, never one flight each."""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from operator import itemgetter

import polars as pl

from dagster_batched.runs import range_tags
from pipelines import partitions

CELLS_A_RUN = 1_000  # flights a run that reads files takes at most: memory grows neither with the fleet nor its history
Cell = tuple[str, str]
"""Keys of an aircraft and of one of its flights, which is empty above flights."""


@dataclass(frozen=True, slots=True)
class PartitionBatch:
    """One run's worth of cells in the order of their partitions, from flight to flight; none is the fleet's."""

    cells: tuple[Cell, ...] = ()
    flights: tuple[str, str] = ("", "")

    @property
    def aircraft(self) -> list[str]:
        """Keys of its aircraft."""
        return list(dict.fromkeys(map(itemgetter(0), self.cells)))

    @property
    def size(self) -> int:
        """How many cells it makes."""
        return len(self.cells) or 1

    @property
    def label(self) -> str:
        """Whose it is."""
        return self.cells[0][0] if self.cells else "fleet"

    def partition_keys(self) -> Sequence[str]:
        """Partition keys."""
        return partitions.cell_keys(self.cells) if self.flights[0] else self.aircraft

    def parts(self) -> list["PartitionBatch"]:
        """The same in smaller runs: an aircraft each or, of one aircraft, halves; none where there is one cell."""
        own = [tuple(cells) for _, cells in groupby(self.cells, key=itemgetter(0))]
        if len(own) == 1:
            half = len(self.cells) // 2
            own = [self.cells[:half], self.cells[half:]] if half else []
        return [PartitionBatch(cells, (cells[0][1], cells[-1][1])) for cells in own]

    def tags(self) -> dict[str, str]:
        """Dagster's range tags and, for whoever looks for an aircraft's runs, its name."""
        aircraft = self.aircraft
        if not aircraft:
            return {}
        named = {"hdt/aircraft": aircraft[0]} if len(aircraft) == 1 else {}
        operators = {a.split(":")[0] for a in aircraft}
        named |= {"hdt/operator": operators.pop()} if len(operators) == 1 else {}
        return range_tags(*self.ends()) | named

    def ends(self) -> Cell:
        """Partition keys of the first and the last cell of the range that it lies in."""
        sides = zip((self.cells[0][0], self.cells[-1][0]), self.flights, strict=True)
        first, last = (f"{aircraft}|{flight}" if flight else aircraft for aircraft, flight in sides)
        return first, last


@dataclass(frozen=True, slots=True)
class BatchResult:
    """What came of a batch: cells and runs, what failed, with why, and what went well only at the second try."""

    cells: int
    runs: int
    failed: dict[str, str] = field(default_factory=dict)
    mended: tuple[str, ...] = ()


def made_apart(label: str, batch: PartitionBatch, why: str) -> tuple[str, ...]:
    """The line about a run that failed and whose parts did not: that they are made must not hide it."""
    whole = (
        f"{len(batch.aircraft)} aircraft stopped, so each"
        if len(batch.aircraft) > 1
        else "1 aircraft stopped, so each part"
    )
    return (f"{label}: a run of {whole} was made alone; report it: {why}",)


@dataclass(frozen=True, slots=True)
class PartitionIndex:
    """Partition keys in Dagster's order, and the flights that each aircraft has flown."""

    aircraft: list[str]
    flights: list[str]
    flown: dict[str, set[str]]

    def batches(
        self, grain: str, wanted: pl.DataFrame, folded: int = 1, among: int = 1, *, ranges: bool = False
    ) -> Iterator[PartitionBatch]:
        """Runs that make the wanted cells (operator, tail, flight_id) and no other, `folded` times `CELLS_A_RUN`.

        They are shared evenly `among` so many processes, by whole aircraft. As `ranges` each is all that was flown from
        its first cell to its last, for machines that are told no more.
        """
        if grain == "fleet":
            return iter([PartitionBatch()])
        of = self._aircraft if grain == "aircraft" else self._flights
        most, flights = folded * CELLS_A_RUN, self.count(grain, wanted)
        runs = among * max(1, math.ceil(flights / (among * most)))  # none left over that one process makes alone
        share = math.ceil(flights / runs)
        return self._gathered(of(by_aircraft(wanted), min(most, share)), most, share, ranges)

    def count(self, grain: str, wanted: pl.DataFrame) -> int:
        """Flights of the wanted cells; of an aircraft's, all that it has flown."""
        if grain == "flight":
            return wanted.height
        return sum(len(self.flown.get(aircraft, ())) for aircraft in by_aircraft(wanted))

    def _gathered(
        self, stretches: Iterator[list[Cell]], most: int, share: int, ranges: bool
    ) -> Iterator[PartitionBatch]:
        """Stretches together as long as they hold no more flights than one run may, nor much more than its share."""
        place = {key: i for i, key in enumerate(self.flights)}
        flown = [sorted(place[f] for f in self.flown.get(a, ()) if f in place) for a in self.aircraft] if ranges else []
        held, size = list[Cell](), 0
        for stretch in stretches:
            more = len(stretch) if stretch[0][1] else len(self.flown.get(stretch[0][0], ()))
            full = size + more > most or size + more / 2 > share
            if held and (full or (ranges and not self._is_range([*held, *stretch], flown, place))):
                yield _batch(held, place)
                held, size = [], 0
            held, size = held + stretch, size + more
        if held:
            yield _batch(held, place)

    def _aircraft(self, asked: dict[str, set[str]], most: int) -> Iterator[list[Cell]]:
        return ([(a, "")] for a in self.aircraft if a in asked)

    def _flights(self, asked: dict[str, set[str]], most: int) -> Iterator[list[Cell]]:
        """Of each aircraft, stretches of its flights that are all wanted, none longer than `most`."""
        place = {key: i for i, key in enumerate(self.flights)}
        for a in (a for a in self.aircraft if a in asked):
            own = sorted((f for f in self.flown.get(a, ()) if f in place), key=place.__getitem__)
            for is_wanted, found in groupby(own, key=asked[a].__contains__):
                stretch = [(a, f) for f in found if is_wanted]
                yield from (stretch[i : i + most] for i in range(0, len(stretch), most))

    def _is_range(self, cells: list[Cell], flown: list[list[int]], place: dict[str, int]) -> bool:
        """Whether nothing else was flown from the first of some cells to the last."""
        first, last = self.aircraft.index(cells[0][0]), self.aircraft.index(cells[-1][0])
        if not cells[0][1]:
            return last - first == len(cells) - 1
        at = [place[f] for _, f in cells]
        between = (bisect_right(own, max(at)) - bisect_left(own, min(at)) for own in flown[first : last + 1])
        return sum(between) == len(cells)


def _batch(cells: list[Cell], place: dict[str, int]) -> PartitionBatch:
    """A flight's key begins with its day, but a late one was added behind the others."""
    flights = [f for _, f in cells if f]
    at = place.__getitem__
    return PartitionBatch(tuple(cells), (min(flights, key=at), max(flights, key=at)) if flights else ("", ""))


def by_aircraft(cells: pl.DataFrame) -> dict[str, set[str]]:
    """Flight keys of each aircraft's key, from operator, tail and flight_id (empty above flights)."""
    found: dict[str, set[str]] = {}
    for o, t, f in cells.select("operator", "tail", "flight_id").rows():
        found.setdefault(partitions.aircraft_key(o, t), set()).add(partitions.flight_key(f))
    return found
