"""Record of a fleet: flights that have a prognosis already, and each month's training data.

The model of a month is fitted to the record of when the month began. Late files change that by some flights in a
hundred thousand. A new fit for these would move predictions by a tenth of a flight and make all of them again; so they
enter from the next month on.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from datetime import UTC, date, datetime

import numpy as np
import polars as pl

from hdt_core.prognosis.choices import Washes
from hdt_core.prognosis.feature_rows import Tracks
from hdt_core.prognosis.recalibrate import TERMS
from hdt_core.prognosis.unit_lives import episodes, life_table, units_on_record
from hdt_core.records.keys import PACK
from hdt_core.robust import Array

ScoredFlights = dict[str, tuple[int, str]]
"""Of each pack, `component|operator|tail|pack`: its flights of a month, and a digest of a prognosis's inputs."""
MATERIAL_SHARE = 0.01
"""Share of a fleet's flights that may come late, or be withdrawn, and of its ended lives that may come to be another,
before a month's model is fitted again."""


@dataclass(frozen=True, slots=True)
class FleetRecord:
    """Flights with their health, messages and log of a fleet.

    Attributes
    ----------
    features : DataFrame
        operator, tail, flight_id, pack, departed_at and the losses that `feature_rows.tracks` reads.
    messages, maintenance : DataFrame
        As for `unit_lives.episodes`.
    washes : mapping of str to Washes
        Measured washes by component.
    """

    features: pl.DataFrame
    messages: pl.DataFrame
    maintenance: pl.DataFrame
    washes: Mapping[str, Washes] = field(default_factory=dict)

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

    def units(self) -> pl.DataFrame:
        """Return which units flew by the record of each flight's time."""
        return units_on_record(self.features, self.messages, self.maintenance)


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
    is_new = np.ones(len(track.at), dtype=bool)
    start = 0
    is_unchanged = True
    last: list[object] = []
    months = track.keys.select(*PACK, month_of(track.keys["departed_at"]).alias("month"))
    for *pack, month, flights in months.group_by(*PACK, "month", maintain_order=True).len().rows():
        name = "|".join(str(part) for part in (component, *pack))
        numbers = _inputs(track, start, start + flights)
        flights_by_month.setdefault(month, {})[name] = (flights, _digest(*numbers, flights))
        n, digest = scored_before.get(month, {}).get(name, (0, ""))
        is_unchanged = (is_unchanged or pack != last) and 0 < n <= flights and _digest(*numbers, n) == digest
        is_new[start : start + n] = not is_unchanged
        is_unchanged = is_unchanged and n == flights
        last = pack
        start = start + flights
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


@dataclass(frozen=True, slots=True)
class TrainingDigest:
    """Training data of a model.

    Attributes
    ----------
    base : str
        Version of the base, and terms of its correction.
    design : str
        Digest of the models and of the code of features.
    tails : list of str
        Aircraft that have a fold: those that had flown by the end of the month.
    operators : list of str
        Those that had given a message of any kind.
    ended : list of str
        A digest of each ended life: unit, first flight, and the flight of its message.
    flights : dict
        Number by `operator|tail|pack`.
    """

    base: str
    design: str
    tails: list[str]
    operators: list[str]
    ended: list[str]
    flights: dict[str, int]


def training_digests(record: FleetRecord, base: str, design: str = "") -> dict[date, TrainingDigest]:
    """Digest the training data of each month's model: the record before the month began."""
    base = f"{base} {' '.join(TERMS)}"
    month = month_of(record.features["departed_at"]).alias("month")
    flights = record.features.select(*PACK, month).group_by(*PACK, "month").len().sort(*PACK, "month")
    messages = record.messages.select("operator", month_of(record.messages["message_time"]).alias("month")).unique()
    ended_lives = _ended_lives(record)

    def digest(month: date) -> TrainingDigest:
        is_past = pl.col("month") < month
        tails = flights.filter(pl.col("month") <= month)["tail"].unique().sort().to_list()
        operators = messages.filter(is_past)["operator"].unique().sort().to_list()
        packs = flights.filter(is_past).group_by(PACK, maintain_order=True).agg(pl.col("len").sum())
        counts = {"|".join(map(str, pack)): n for *pack, n in packs.rows()}
        return TrainingDigest(base, design, tails, operators, sorted(ended_lives.filter(is_past)["life"]), counts)

    return {month: digest(month) for month in record.months()}


def retraining_reason(now: TrainingDigest, last: TrainingDigest | None) -> str:
    """Return why a model is fitted, or fitted again; empty where it stays.

    Parameters
    ----------
    now : TrainingDigest
        Its training data tonight.
    last : TrainingDigest or None
        Its training data when it was fitted; None where the month has no model.
    """
    if last is None:
        return "the month began"
    packs = now.flights.keys() | last.flights.keys()
    changes = sum(abs(now.flights.get(p, 0) - last.flights.get(p, 0)) for p in packs)
    lives = max(len(set(a.ended) - set(b.ended)) for a, b in ((now, last), (last, now)))
    reasons = {
        "the base is another": now.base != last.base,
        "the aircraft's models or the code of features are others": now.design != last.design,
        "an aircraft joined or left": now.tails != last.tails,
        "an operator's first message came late": now.operators != last.operators,
        f"lives that had ended are others: {lives}": lives > MATERIAL_SHARE * len(last.ended),
        f"{changes} flights of earlier months came late or went": changes > MATERIAL_SHARE * sum(last.flights.values()),
    }
    return next((reason for reason, applies in reasons.items() if applies), "")


def flights_not_learned(now: TrainingDigest, last: TrainingDigest) -> int:
    """Count flights of earlier months, by pack, that came after the model was fitted."""
    return sum(max(0, n - last.flights.get(pack, 0)) for pack, n in now.flights.items())


def _ended_lives(record: FleetRecord) -> pl.DataFrame:
    """Digest lives ended by a message or a replacement, and the month in which the next unit flew: `life`, `month`."""
    lives = life_table(record.features, record.lives()).sort("component", *PACK, "life")
    next_at = pl.col("first_departed_at").shift(-1).over("component", *PACK)
    removals = lives.with_columns(month=next_at.dt.month_start().dt.date()).filter("removed")
    message = pl.when("failed").then("end_flight_id")
    rows = removals.select(*PACK, "component", "failed", "first_flight_id", message.alias("end_flight_id")).rows()
    digests = [hashlib.blake2b(repr(row).encode(), digest_size=5).hexdigest() for row in rows]
    return pl.DataFrame({"life": digests, "month": removals["month"]}, schema={"life": pl.String, "month": pl.Date})
