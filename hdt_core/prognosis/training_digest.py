"""What a model learned from, and whether what it would learn from now is materially another.

A model learns on the first night of a month. Late files change what it was taught by some flights in a hundred
thousand. To learn again for these would move what is said by a tenth of a flight, and all of it be said again; so
they wait for the next month, as they did in the world: when the model learned, nobody knew of them.
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import polars as pl

from hdt_core.margin.exchanger_demand import CRITICAL
from hdt_core.prognosis.feature_rows import ASKS, LOSSES
from hdt_core.prognosis.fleet_record import FleetRecord
from hdt_core.prognosis.unit_lives import told_lives
from hdt_core.records.keys import PACK

MATERIAL_SHARE = 0.01
"""Share of a fleet's flights that may come late, or be withdrawn, and of its ended lives that may come to be told
otherwise, before a model learns within the month."""
MATERIAL_SHIFT = 0.02
"""How far what is told of the packs may move on average, in standard deviations over the fleet."""
_WHEN = "days"
_DIGITS = 6
"""Figures of a mean that are kept: the last ones of a sum depend on the order in which rows came."""


@dataclass(frozen=True, slots=True)
class TrainingDigest:
    """What was known when a model learned.

    Attributes
    ----------
    month : str
        The month at whose beginning it learned, ISO.
    learner : str
        Digest of the base, of what is corrected, and of the tails that have a fold.
    ended : list of str
        Of each life that had ended a digest: whose, from which flight on, and the flight of its message.
    columns : list of str
        What a prognosis is made of.
    spread : list of float
        Standard deviation of each column over all flights; 0 where it is not known.
    packs : dict
        By `operator|tail|pack`: how many flights, and the mean of each column, None where it is not known.
    """

    month: str
    learner: str
    ended: list[str]
    columns: list[str]
    spread: list[float]
    packs: dict[str, tuple[int, list[float | None]]]

    @property
    def flights(self) -> int:
        """Flights of all packs."""
        return sum(n for n, _ in self.packs.values())

    def to_json(self) -> str:
        """As it is stored."""
        return json.dumps(asdict(self), separators=(",", ":"))


def training_digest(record: FleetRecord, learner: str) -> TrainingDigest:
    """What a model that learns tonight is taught: all that was on record when the month of the last flight began."""
    month = record.month()
    past = record.before(month)
    columns = [c for c in (*LOSSES, *CRITICAL, *ASKS) if c in past.features.columns]
    numbers = [pl.col(c).cast(pl.Float64).fill_nan(None) for c in columns]
    dated = past.features.select(*PACK, *numbers, (pl.col("departed_at").dt.epoch("s") / 86_400.0).alias(_WHEN))
    columns = [*columns, _WHEN]
    spread = dated.select(_told(pl.col(columns).std().fill_null(0.0))).row(0)
    means = dated.group_by(PACK).agg(pl.len(), _told(pl.col(columns).mean())).sort(PACK)
    n_keys = len(PACK)
    packs = {"|".join(str(k) for k in row[:n_keys]): (row[n_keys], [*row[n_keys + 1 :]]) for row in means.rows()}
    return TrainingDigest(month.date().isoformat(), learner, _ended(past), columns, [float(s) for s in spread], packs)


def _told(value: pl.Expr) -> pl.Expr:
    return value.round(_DIGITS).round_sig_figs(_DIGITS)


def read_digest(stored: str) -> TrainingDigest | None:
    """What `to_json` gave; None for anything else, such as what older homes kept."""
    if not stored.startswith("{"):
        return None
    told: dict[str, Any] = json.loads(stored)
    return TrainingDigest(**told)


def why_learn(now: TrainingDigest, then: TrainingDigest | None) -> str:
    """Why a model that was taught `then` learns again; empty where it need not.

    Parameters
    ----------
    now : TrainingDigest
        What a model would be taught tonight.
    then : TrainingDigest or None
        What the model in service was taught.
    """
    if then is None:
        return "no model is in service of which it is known what it learned from"
    came = sum(abs(_flights(now, pack) - _flights(then, pack)) for pack in now.packs.keys() | then.packs.keys())
    moved = _moved(now, then) if now.columns == then.columns else {}
    worst = max(moved, key=moved.__getitem__, default="")
    lives = max(len(set(a.ended) - set(b.ended)) for a, b in ((now, then), (then, now)))
    reasons = {
        f"the month began on {now.month}": now.month != then.month,
        "the base is another, or an aircraft joined": now.learner != then.learner,
        f"lives that had ended are told otherwise: {lives}": lives > MATERIAL_SHARE * len(then.ended),
        f"{came} flights of earlier months came late or went": came > MATERIAL_SHARE * then.flights,
        "what is known of flights is another": now.columns != then.columns,
        f"{worst} of earlier flights moved": moved.get(worst, 0.0) > MATERIAL_SHIFT,
    }
    return next((why for why, holds in reasons.items() if holds), "")


def flights_not_learned(now: TrainingDigest, then: TrainingDigest) -> int:
    """Flights of earlier months, by pack, that came after the model had learned."""
    return sum(max(0, n - _flights(then, pack)) for pack, (n, _) in now.packs.items())


def _flights(digest: TrainingDigest, pack: str) -> int:
    return digest.packs[pack][0] if pack in digest.packs else 0


def _moved(now: TrainingDigest, then: TrainingDigest) -> dict[str, float]:
    """By column how far the packs' means moved, weighted by their flights, in standard deviations over the fleet."""
    both = sorted(now.packs.keys() & then.packs.keys())
    if not both:
        return {}
    new, old = (np.array([digest.packs[p][1] for p in both], dtype=float) for digest in (now, then))
    flights = np.array([then.packs[p][0] for p in both], dtype=float)
    spread = np.maximum(np.array(then.spread), 100.0 * 10.0**-_DIGITS)  # a column that hardly moves says nothing
    shift = np.where(np.isnan(new) & np.isnan(old), 0.0, np.abs(new - old) / spread)
    shift = np.where(np.isnan(shift), 1.0, shift)  # what was not known is, or the other way round
    return dict(zip(then.columns, (flights @ shift / flights.sum()).tolist(), strict=True))


def _ended(past: FleetRecord) -> list[str]:
    """Digests of the lives that a message or a replacement ended."""
    told = told_lives(past.features, past.lives()).filter(pl.col("removed") | pl.col("failed"))
    failed = pl.when("failed").then("end_flight_id")
    known = told.select(*PACK, "component", "failed", "mute", "first_flight_id", failed.alias("end_flight_id"))
    return sorted(hashlib.blake2b(repr(row).encode(), digest_size=5).hexdigest() for row in known.rows())
