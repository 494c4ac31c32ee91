"""Which cells share a run: a range of flights of one or several aircraft, never one flight each."""

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby

import polars as pl

from dagster_batched.runs import range_tags
from pipelines import partitions

CELLS_A_RUN = 1_000  # flights a run that reads files takes at most: memory grows neither with the fleet nor its history


@dataclass(frozen=True, slots=True)
class PartitionBatch:
    """One run's worth of cells: aircraft in partition order and, below them, flights from `first` to `last`.

    Where it has `parts` it is these and nothing between them.
    """

    cells: int = 1
    aircraft: tuple[str, ...] = ()
    first: str = ""
    last: str = ""
    parts: tuple["PartitionBatch", ...] = ()

    def apart(self) -> list["PartitionBatch"]:
        """The same in smaller runs: its parts, or one aircraft at a time."""
        return [*self.parts] or [PartitionBatch(1, (a,), self.first, self.last) for a in self.aircraft]

    def joined(self, other: "PartitionBatch", place: dict[str, int]) -> "PartitionBatch":
        """Both in one range of flights."""
        first = min(self.first, other.first, key=place.__getitem__)
        last = max(self.last, other.last, key=place.__getitem__)
        return PartitionBatch(self.cells + other.cells, self.aircraft + other.aircraft, first, last)

    def tags(self) -> dict[str, str]:
        """Dagster's range tags and, for whoever looks for an aircraft's runs, its name."""
        if not self.aircraft:
            return {}
        named = {"hdt/aircraft": self.aircraft[0]} if len(self.aircraft) == 1 else {}
        operators = {a.split(":")[0] for a in self.aircraft}
        named |= {"hdt/operator": operators.pop()} if len(operators) == 1 else {}
        return range_tags(*self.ends()) | named

    def ends(self) -> tuple[str, str]:
        """Partition keys of the first and the last cell."""
        start, end = self.aircraft[0], self.aircraft[-1]
        return (f"{start}|{self.first}", f"{end}|{self.last}") if self.first else (start, end)


@dataclass(frozen=True, slots=True)
class BatchResult:
    """What came of a block: how many runs it took, what failed, with why, and what went well only at the second try."""

    block: PartitionBatch
    runs: int
    failed: dict[str, str]
    mended: tuple[str, ...] = ()


def made_apart(label: str, block: PartitionBatch, why: str) -> tuple[str, ...]:
    """The line about a run of several aircraft that failed: that each is made alone must not hide it."""
    return (f"{label}: a run of {len(block.aircraft)} aircraft stopped, so each was made alone; report it: {why}",)


@dataclass(frozen=True, slots=True)
class PartitionIndex:
    """Partition keys in Dagster's order, and the flights that each aircraft has flown."""

    aircraft: list[str]
    flights: list[str]
    flown: dict[str, set[str]]

    def cells(self, block: PartitionBatch) -> list[str]:
        """Partition keys of the block that a flight, or an aircraft, can fill."""
        if block.parts:
            return [cell for part in block.parts for cell in self.cells(part)]
        if not block.first:
            return list(block.aircraft)
        span = set(self.flights[self.flights.index(block.first) : self.flights.index(block.last) + 1])
        return [partitions.cell_key(a, f) for a in block.aircraft for f in sorted(self.flown[a] & span)]

    def halves(self, block: PartitionBatch) -> list[PartitionBatch]:
        """The flights of one aircraft's block in two parts; none where there are no two to part."""
        if not block.first:
            return []
        span = self.flights[self.flights.index(block.first) : self.flights.index(block.last) + 1]
        own = [f for f in span if f in self.flown[block.aircraft[0]]]
        parts = (own[: len(own) // 2], own[len(own) // 2 :]) if len(own) > 1 else ()
        return [PartitionBatch(len(part), block.aircraft, part[0], part[-1]) for part in parts]

    def blocks(
        self, grain: str, wanted: pl.DataFrame, folded: int = 1, *, scattered: bool = False
    ) -> Iterator[PartitionBatch]:
        """Runs that make the wanted cells (operator, tail, flight_id) and no other, `folded` times `CELLS_A_RUN`.

        Where a run may take `scattered` cells, few runs make what is new of many aircraft on many days.
        """
        if grain == "fleet":
            return iter([PartitionBatch()])
        of, most = self._of_aircraft if grain == "aircraft" else self._of_flights, folded * CELLS_A_RUN
        found = of(by_aircraft(wanted), most)
        return self._gathered(found, most) if scattered else found

    def _gathered(self, blocks: Iterator[PartitionBatch], most: int) -> Iterator[PartitionBatch]:
        """Blocks together in one as long as they hold no more flights than one may."""
        waiting, held = list[PartitionBatch](), 0
        for block in blocks:
            size = block.cells if block.first else sum(len(self.flown.get(a, ())) for a in block.aircraft)
            if waiting and held + size > most:
                yield self._as_one(waiting)
                waiting, held = [], 0
            waiting.append(block)
            held += size
        if waiting:
            yield self._as_one(waiting)

    def _as_one(self, parts: list[PartitionBatch]) -> PartitionBatch:
        if len(parts) == 1:
            return parts[0]
        named = {a for part in parts for a in part.aircraft}
        aircraft = tuple(a for a in self.aircraft if a in named)
        # a flight's key begins with its day, but a late one was added behind the others
        place = {key: i for i, key in enumerate(self.flights)} if parts[0].first else {"": 0}
        first = min((part.first for part in parts), key=place.__getitem__)
        last = max((part.last for part in parts), key=place.__getitem__)
        return PartitionBatch(sum(part.cells for part in parts), aircraft, first, last, tuple(parts))

    def _of_aircraft(self, asked: dict[str, set[str]], most: int) -> Iterator[PartitionBatch]:
        """Neighbours that are all wanted, as many as share a run without holding too many flights at once."""
        for stretch in _stretches(self.aircraft, asked, most):
            held, shared = 0, list[str]()
            for aircraft in stretch:
                held += len(self.flown.get(aircraft, ()))
                if shared and held > most:
                    yield PartitionBatch(len(shared), tuple(shared))
                    held, shared = len(self.flown.get(aircraft, ())), []
                shared.append(aircraft)
            yield PartitionBatch(len(shared), tuple(shared))

    def _of_flights(self, asked: dict[str, set[str]], most: int) -> Iterator[PartitionBatch]:
        """Of each aircraft, stretches of its flights that are all wanted; neighbours share a run if none gains one."""
        place = {k: i for i, k in enumerate(self.flights)}
        fixed = {a: sorted(place[f] for f in own - asked.get(a, set()) if f in place) for a, own in self.flown.items()}
        shared: PartitionBatch | None = None
        before = ""
        for aircraft in self.aircraft:
            own = sorted((f for f in self.flown.get(aircraft, ()) if f in place), key=place.__getitem__)
            for stretch in _stretches(own, asked.get(aircraft, set()), most):
                alone = PartitionBatch(len(stretch), (aircraft,), stretch[0], stretch[-1])
                joined = shared.joined(alone, place) if shared and shared.aircraft[-1] == before else None
                if joined and joined.cells <= most and all(_free(fixed[a], joined, place) for a in joined.aircraft):
                    shared = joined
                    continue
                if shared:
                    yield shared
                shared = alone
            before = aircraft
        if shared:
            yield shared


def by_aircraft(cells: pl.DataFrame) -> dict[str, set[str]]:
    """Flight keys of each aircraft's key, from operator, tail and flight_id (empty above flights)."""
    found: dict[str, set[str]] = {}
    for o, t, f in cells.select("operator", "tail", "flight_id").rows():
        found.setdefault(partitions.aircraft_key(o, t), set()).add(partitions.flight_key(f))
    return found


def _stretches(keys: list[str], wanted: set[str] | dict[str, set[str]], most: int) -> Iterator[list[str]]:
    """Runs of neighbouring keys that are all wanted, none longer than `most`."""
    for is_wanted, found in groupby(keys, key=wanted.__contains__):
        if is_wanted:
            stretch = list(found)
            yield from (stretch[i : i + most] for i in range(0, len(stretch), most))


def _free(fixed: list[int], block: PartitionBatch, place: dict[str, int]) -> bool:
    """Whether none of an aircraft's flights that must not be made again lies in the block's range."""
    i = bisect_left(fixed, place[block.first])
    return i == len(fixed) or fixed[i] > place[block.last]
