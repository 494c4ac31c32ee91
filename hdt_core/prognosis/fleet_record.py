"""Record of a fleet, and the flights of it that have a prognosis already."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import UTC, date, datetime

import numpy as np
import polars as pl

from hdt_core.prognosis.feature_rows import Tracks
from hdt_core.prognosis.unit_lives import episodes
from hdt_core.records.keys import PACK
from hdt_core.robust import Array

ScoredFlights = dict[str, tuple[int, str]]
"""Of each pack, `component|operator|tail|pack`: its flights of a month, and a digest of a prognosis's inputs."""


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

    def as_of(self, moment: datetime) -> "FleetRecord":
        """Return the record at a moment, without later flights, messages or log entries."""
        return FleetRecord(
            self.features.filter(pl.col("departed_at") < moment),
            self.messages.filter(pl.col("message_time") < moment),
            self.maintenance.filter(pl.col("done_on") < moment.date()),
        )

    def months(self) -> list[date]:
        """Return first days of the months in which flights departed, UTC."""
        return month_of(self.features["departed_at"]).unique().sort().to_list()

    def lives(self) -> pl.DataFrame:
        """Cut the lives of all units."""
        return episodes(self.features, self.messages, self.maintenance)


def month_of(departed_at: pl.Series) -> pl.Series:
    """Return the first day of each flight's month, UTC."""
    return departed_at.dt.month_start().dt.date()


def start_of(month: date) -> datetime:
    """Return the first moment of a month, UTC."""
    return datetime(month.year, month.month, month.day, tzinfo=UTC)


def score_months(
    track: Tracks, component: str, scored_before: Mapping[date, ScoredFlights]
) -> tuple[dict[date, ScoredFlights], Array]:
    """Digest each pack's flights by month; return also which flights are new or changed since `scored_before`. (n,)

    The prognosis of a flight follows from it and those before it, so all after one that changed count as new.
    """
    flights_by_month: dict[date, ScoredFlights] = {}
    is_new, start, is_unchanged = np.ones(len(track.at), dtype=bool), 0, True
    last: list[object] = []
    months = track.keys.select(*PACK, month_of(track.keys["departed_at"]).alias("month"))
    for *pack, month, flights in months.group_by(*PACK, "month", maintain_order=True).len().rows():
        name, numbers = "|".join(str(part) for part in (component, *pack)), _inputs(track, start, start + flights)
        flights_by_month.setdefault(month, {})[name] = (flights, _digest(*numbers, flights))
        n, digest = scored_before.get(month, {}).get(name, (0, ""))
        is_unchanged = (is_unchanged or pack != last) and 0 < n <= flights and _digest(*numbers, n) == digest
        is_new[start : start + n] = not is_unchanged
        is_unchanged, last, start = is_unchanged and n == flights, pack, start + flights
    return flights_by_month, is_new


def _inputs(track: Tracks, start: int, end: int) -> tuple[Array, list[str]]:
    """Return a prognosis's inputs flight by flight: health, margin, age, and the flight's name."""
    life, column = track.at[start:end].T
    pack, flight = track.curve_index[start:end].T
    state = [getattr(track.panel, f.name)[life, column] for f in fields(track.panel)]
    curves = track.curves[pack, flight].reshape(end - start, -1)
    return np.column_stack([*state, column, curves]).astype(float), track.keys["flight_id"][start:end].to_list()


def _digest(numbers: Array, names: list[str], flights: int) -> str:
    content = numbers[:flights].tobytes() + "|".join(names[:flights]).encode()
    return hashlib.blake2b(content, digest_size=8).hexdigest()
