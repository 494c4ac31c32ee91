"""Digest each month's training data, and decide whether it has changed materially since the fit.

The model of a month is fitted to the record of when the month began. Late files change that by some flights in a
hundred thousand. A new fit for these would move predictions by a tenth of a flight and make all of them again; so they
enter from the next month on.
"""

import hashlib
from dataclasses import dataclass
from datetime import date

import polars as pl

from hdt_core.prognosis.fleet_record import FleetRecord, month_of
from hdt_core.prognosis.recalibrate import TERMS
from hdt_core.prognosis.unit_lives import life_table
from hdt_core.records.keys import PACK

MATERIAL_SHARE = 0.01
"""Share of a fleet's flights that may come late, or be withdrawn, and of its ended lives that may come to be another,
before a month's model is fitted again."""


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
