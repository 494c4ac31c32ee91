"""What each month's model learns from, and whether that is materially another than what it learned from.

The model of a month learns from what was on record when the month began. Late files change that by some flights in a
hundred thousand. To learn again for these would move what was foretold by a tenth of a flight, and all of it would be
made again; so they count from the next month on, as they did in the world: when the model learned, nobody knew of them.
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from datetime import date
from typing import Any

import polars as pl

from hdt_core.prognosis.fleet_record import FleetRecord, month_of
from hdt_core.prognosis.recalibrate import TERMS
from hdt_core.prognosis.unit_lives import told_lives
from hdt_core.records.keys import PACK

MATERIAL_SHARE = 0.01
"""Share of a fleet's flights that may come late, or be withdrawn, and of its ended lives that may come to be another,
before a month's model learns again."""


@dataclass(frozen=True, slots=True)
class TrainingDigest:
    """What is on record when a model learns.

    Attributes
    ----------
    base : str
        Version of the base, and what is corrected of it.
    design : str
        Digest of the models and of the code that features follow from.
    tails : list of str
        Aircraft that have a fold: those that had flown by the end of the month.
    operators : list of str
        Those that had given a message of any kind.
    ended : list of str
        Of each life that had ended a digest: whose, from which flight on, and the flight of its message.
    flights : dict
        By `operator|tail|pack` how many.
    """

    base: str
    design: str
    tails: list[str]
    operators: list[str]
    ended: list[str]
    flights: dict[str, int]

    def to_json(self) -> str:
        """As it is stored."""
        return json.dumps(asdict(self), separators=(",", ":"))


def training_digests(record: FleetRecord, base: str, design: str = "") -> dict[date, TrainingDigest]:
    """What the model of each month of the record learns from: all that was on record before the month began."""
    base = f"{base} {' '.join(TERMS)}"
    month = month_of(record.features["departed_at"]).alias("month")
    flights = record.features.select(*PACK, month).group_by(*PACK, "month").len().sort(*PACK, "month")
    messages = record.messages.select("operator", month_of(record.messages["message_time"]).alias("month")).unique()
    ended = _ended(record)

    def digest(month: date) -> TrainingDigest:
        before = pl.col("month") < month
        tails = flights.filter(pl.col("month") <= month)["tail"].unique().sort().to_list()
        operators = messages.filter(before)["operator"].unique().sort().to_list()
        packs = flights.filter(before).group_by(PACK, maintain_order=True).agg(pl.col("len").sum())
        counts = {"|".join(map(str, pack)): n for *pack, n in packs.rows()}
        return TrainingDigest(base, design, tails, operators, sorted(ended.filter(before)["life"]), counts)

    return {month: digest(month) for month in record.months()}


def read_digest(stored: str) -> TrainingDigest:
    """What `to_json` gave."""
    fields: dict[str, Any] = json.loads(stored)
    return TrainingDigest(**fields)


def why_learn(now: TrainingDigest, then: TrainingDigest | None) -> str:
    """Why a model is learned, or learned again; empty where it stands.

    Parameters
    ----------
    now : TrainingDigest
        What it would learn from tonight.
    then : TrainingDigest or None
        What it learned from; None where the month has no model.
    """
    if then is None:
        return "the month began"
    came = sum(abs(now.flights.get(p, 0) - then.flights.get(p, 0)) for p in now.flights.keys() | then.flights.keys())
    lives = max(len(set(a.ended) - set(b.ended)) for a, b in ((now, then), (then, now)))
    reasons = {
        "the base is another": now.base != then.base,
        "the aircraft's models or the code of features are others": now.design != then.design,
        "an aircraft joined or left": now.tails != then.tails,
        "an operator's first message came late": now.operators != then.operators,
        f"lives that had ended are others: {lives}": lives > MATERIAL_SHARE * len(then.ended),
        f"{came} flights of earlier months came late or went": came > MATERIAL_SHARE * sum(then.flights.values()),
    }
    return next((why for why, holds in reasons.items() if holds), "")


def flights_not_learned(now: TrainingDigest, then: TrainingDigest) -> int:
    """Flights of earlier months, by pack, that came after the model had learned."""
    return sum(max(0, n - then.flights.get(pack, 0)) for pack, n in now.flights.items())


def _ended(record: FleetRecord) -> pl.DataFrame:
    """Digests of the lives that a message or a replacement ended, and the month in which the next unit flew: `life`,
    `month`."""
    lives = told_lives(record.features, record.lives()).sort("component", *PACK, "life")
    next_at = pl.col("first_departed_at").shift(-1).over("component", *PACK)
    ended = lives.with_columns(month=next_at.dt.month_start().dt.date()).filter("removed")
    message = pl.when("failed").then("end_flight_id")
    rows = ended.select(*PACK, "component", "failed", "first_flight_id", message.alias("end_flight_id")).rows()
    digests = [hashlib.blake2b(repr(row).encode(), digest_size=5).hexdigest() for row in rows]
    return pl.DataFrame({"life": digests, "month": ended["month"]}, schema={"life": pl.String, "month": pl.Date})
