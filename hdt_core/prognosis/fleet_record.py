"""What a fleet has on record, as it stood at any time, and which flights have their prognosis already."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from datetime import UTC, datetime

import numpy as np
import polars as pl

from hdt_core.prognosis.feature_rows import PRIOR_RULES, Tracks, tracks
from hdt_core.prognosis.unit_lives import episodes
from hdt_core.records.keys import PACK

BLOCK = 100
"""Flights that share a digest: prognoses of the blocks before a late flight stand."""
ScoredFlights = dict[str, tuple[int, list[str]]]
"""Of each pack, `operator|tail|pack`: how many flights, and of every block of them a digest of their health."""


@dataclass(frozen=True, slots=True)
class FleetRecord:
    """Flights with their health, messages and log of a fleet.

    Attributes
    ----------
    features : DataFrame
        operator, tail, flight_id, pack, departed_at and the losses that `feature_rows.tracks` reads.
    messages, maintenance : DataFrame
        As for `unit_lives.episodes`.
    """

    features: pl.DataFrame
    messages: pl.DataFrame
    maintenance: pl.DataFrame

    def before(self, moment: datetime) -> "FleetRecord":
        """What was known then: nothing that was flown, raised or signed later."""
        return FleetRecord(
            self.features.filter(pl.col("departed_at") < moment),
            self.messages.filter(pl.col("message_time") < moment),
            self.maintenance.filter(pl.col("done_on") < moment.date()),
        )

    def month(self) -> datetime:
        """First moment of the month of the last flight, UTC; of the year 1 where none has flown."""
        last = self.features["departed_at"].max()
        newest = last if isinstance(last, datetime) else datetime(1, 1, 1, tzinfo=UTC)
        return datetime(newest.year, newest.month, 1, tzinfo=UTC)

    def lives(self) -> pl.DataFrame:
        """Lives of all units."""
        return episodes(self.features, self.messages, self.maintenance)

    def tracks(self) -> "FleetTracks":
        """Health tracks by component."""
        return FleetTracks(self.features, self.lives())


@dataclass(frozen=True, slots=True)
class FleetTracks(Mapping[str, Tracks]):
    """Health tracks by component, cut whenever one is asked for: those of a large fleet are larger than its record."""

    features: pl.DataFrame
    lives: pl.DataFrame

    def __getitem__(self, component: str) -> Tracks:
        return tracks(self.features, self.lives, component)

    def __iter__(self) -> Iterator[str]:
        return iter(PRIOR_RULES)

    def __len__(self) -> int:
        return len(PRIOR_RULES)


def scored(track: Tracks, earlier: ScoredFlights | None = None) -> tuple[ScoredFlights, np.ndarray]:
    """Digests of each pack's track, and which flights are not, or not as they now are, in `earlier`. (n,) bool

    The prognosis of a flight follows from it and those before it, so all after one that changed are as new.
    """
    told: ScoredFlights = {}
    new, start = np.ones(len(track.at), dtype=bool), 0
    for *pack, flights in track.keys.group_by(PACK, maintain_order=True).len().rows():
        name = "|".join(str(part) for part in pack)
        numbers, names = _told(track, start, start + flights)
        told[name] = (flights, [_digest(numbers, names, k, k + BLOCK) for k in range(0, flights, BLOCK)])
        n, digests = (earlier or {}).get(name, (0, []))
        for block, digest in enumerate(digests):
            first, end = block * BLOCK, min(n, (block + 1) * BLOCK)
            if end > flights or _digest(numbers, names, first, end) != digest:
                break
            new[start + first : start + end] = False
        start += flights
    return told, new


def _told(track: Tracks, start: int, end: int) -> tuple[np.ndarray, list[str]]:
    """What a prognosis is made of, flight by flight: health, margin, age, and the flight's name."""
    life, column = track.at[start:end].T
    pack, flight = track.where[start:end].T
    known = [getattr(track.panel, f.name)[life, column] for f in fields(track.panel)]
    curves = track.curves[pack, flight].reshape(end - start, -1)
    return np.column_stack([*known, column, curves]).astype(float), track.keys["flight_id"][start:end].to_list()


def _digest(numbers: np.ndarray, names: list[str], first: int, end: int) -> str:
    told = numbers[first:end].tobytes() + "|".join(names[first:end]).encode()
    return hashlib.blake2b(told, digest_size=8).hexdigest()
