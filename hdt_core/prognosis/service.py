"""Which model goes into service, when it learns, and what it says tonight.

A model learns once a month, from what was known when the month of the fleet's last flight began; until the next one it
only speaks, and what it has said of a flight stands while that flight's record does. Whatever the order in which data
came, the same record ends with the same prognoses.

A newly learned base and the one in service are asked about the same flights, each tail judged by what the others
taught, so neither can have learned its own answers. The fleet's own lives are taken up by either; only what was learned
before any fleet was seen competes.
"""

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.prognosis.card import Card, Verdict, model_card, promote
from hdt_core.prognosis.metrics import judge, score_prognoses
from hdt_core.prognosis.model import IN_ORDER, Fold, Prognosis, fit_tracks, learn_folds, named, say_by_fold
from hdt_core.prognosis.recalibrate import TERMS
from hdt_core.prognosis.record import Heard, Record, heard
from hdt_core.prognosis.rows import Tracks
from hdt_core.records.keys import PACK


@dataclass(frozen=True, slots=True)
class Served:
    """The model in service, its out-of-fold prognoses, its card with the reason.

    `lesson` is a digest of what it learned from, `heard` of what it has spoken about, by component.
    """

    model: Prognosis
    prognoses: pl.DataFrame
    card: Card
    lesson: str
    heard: dict[str, Heard]


def serve(candidate: Prognosis, last: Served | None, record: Record) -> Served:
    """Put a base into service, corrected by the fleet's lives, unless the one in service does better.

    Parameters
    ----------
    candidate : Prognosis
        Base as learned by the present code.
    last : Served, optional
        What served until now; None on the first night.
    record : Record
        All that is on record.
    """
    past, lived = record.before(record.month()).tracks(), record.tracks()
    tails = record.features["tail"].unique().sort().to_list()
    lesson = _lesson(candidate, past, tails)
    if last is not None and last.lesson == lesson:
        return _speak(last, lived)

    def teach(base: Prognosis) -> _Taught:
        folds = learn_folds(base, past, tails)
        said = say_by_fold(base, folds, lived)
        return _Taught(base, folds, said, score_prognoses(judge(said, record.features, record.lives())))

    taught, verdict = _chosen(teach, candidate, last)
    model = replace(fit_tracks(taught.base, past), folds=taught.folds)
    card = model_card(model, taught.scores) | {"promoted": verdict.promoted, "promotion": verdict.reason}
    return Served(model, taught.said, card, lesson, {c: heard(track)[0] for c, track in lived.items()})


class _Taught(NamedTuple):
    """A base, what a fleet taught each fold of it, what the folds say, and how well."""

    base: Prognosis
    folds: tuple[Fold, ...]
    said: pl.DataFrame
    scores: dict[str, float]


def _chosen(
    teach: Callable[[Prognosis], _Taught], candidate: Prognosis, last: Served | None
) -> tuple[_Taught, Verdict]:
    """The candidate, or what served until now where that says better."""
    new = teach(candidate)
    if last is None:
        return new, Verdict(True, "no other model is in service")
    if inputs(last.model) != inputs(candidate):
        return new, Verdict(True, "the model in service reads other inputs and can't be asked")
    if same_base(candidate, last.model):
        return new, Verdict(True, "the base in service is the one the present code learns")
    old = teach(last.model)
    verdict = promote(model_card(candidate, new.scores), model_card(last.model, old.scores))
    return (new if verdict.promoted else old), verdict


def _speak(last: Served, lived: dict[str, Tracks]) -> Served:
    """Say what has not been said, and again what no longer stands."""
    listened = {c: heard(track, last.heard.get(c)) for c, track in lived.items()}
    asked = {c: new for c, (_, new) in listened.items()}
    key = ["component", *PACK, "flight_id"]
    stand = pl.concat(
        track.keys.filter(~asked[c]).select(*PACK, "flight_id", pl.lit(c).alias("component"))
        for c, track in lived.items()
    )
    kept = last.prognoses.join(stand, on=key, how="semi")
    said = pl.concat([kept, say_by_fold(last.model, last.model.folds, lived, asked)]).sort(IN_ORDER)
    return replace(last, prognoses=said, heard={c: told for c, (told, _) in listened.items()})


def _lesson(candidate: Prognosis, past: dict[str, Tracks], tails: list[str]) -> str:
    """Digest of all that a model may learn from, and of what it learns."""
    told = hashlib.blake2b(json.dumps([named(candidate).version, TERMS, tails]).encode(), digest_size=10)
    for track in past.values():
        told.update(json.dumps(heard(track)[0]).encode())
        told.update(track.left.tobytes() + track.failed.tobytes())
    return told.hexdigest()


def same_base(one: Prognosis, other: Prognosis) -> bool:
    """Whether two models were learned from the same simulated lives: their hazards agree at a few probe points."""
    if one.base_levels != other.base_levels or len(one.hazard) != len(other.hazard):
        return False
    probe = np.linspace(0.0, 1.0, 7)[:, None] * np.ones(inputs(one))
    return all(
        np.allclose(a.predict_proba(probe), b.predict_proba(probe))
        for a, b in zip(one.hazard, other.hazard, strict=True)
    )


def inputs(model: Prognosis) -> int:
    """How many columns the model's hazard reads."""
    return int(model.hazard[0].n_features_in_)
