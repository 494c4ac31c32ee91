"""Which model goes into service, when it learns, and its prognoses of tonight.

A model learns once a month, from what was known when the month of the fleet's last flight began; until the next one it
only scores flights, and a prognosis stands while its flight's record does. Flights of earlier months that come late are
scored at once and learned from when the next month begins, or when they are so many that they matter
(`training_digest`). Whatever the order in which data came, from the next learning on the same record has the same
prognoses.

A newly learned base and the one in service are asked about the same flights, each tail judged by what the others
taught, so neither can have learned its own answers. The fleet's own lives are taken up by either; only what was learned
before any fleet was seen competes.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.prognosis.feature_rows import Tracks
from hdt_core.prognosis.fleet_record import FleetRecord, ScoredFlights, scored
from hdt_core.prognosis.metrics import judge, score_prognoses
from hdt_core.prognosis.model import Prognosis, fit_tracks, named, predict_by_fold
from hdt_core.prognosis.model_card import Card, Verdict, model_card, promote
from hdt_core.prognosis.recalibrate import TERMS
from hdt_core.prognosis.training_digest import flights_not_learned, read_digest, training_digest, why_learn
from hdt_core.records.keys import IN_ORDER, PACK


@dataclass(frozen=True, slots=True)
class ModelUpdate:
    """The model in service, its out-of-fold prognoses, its card with the reason.

    `digest` is what it learned from (`TrainingDigest.to_json`), `scored` which flights have a prognosis, by component.
    """

    model: Prognosis
    prognoses: pl.DataFrame
    card: Card
    digest: str
    scored: dict[str, ScoredFlights]


def update_model(candidate: Prognosis, last: ModelUpdate | None, record: FleetRecord) -> ModelUpdate:
    """Put a base into service, corrected by the fleet's lives, unless the one in service does better.

    Parameters
    ----------
    candidate : Prognosis
        Base as learned by the present code.
    last : ModelUpdate, optional
        What served until now; None on the first night.
    record : FleetRecord
        All that is on record.
    """
    tails = record.features["tail"].unique().sort().to_list()
    digest = training_digest(record, _learner(candidate, tails))
    learned = read_digest(last.digest) if last is not None else None
    why = why_learn(digest, learned)
    if last is not None and learned is not None and not why:
        return _score_new(last, record, flights_not_learned(digest, learned))
    past = record.before(record.month()).tracks()

    def train(base: Prognosis) -> _Trained:
        model = fit_tracks(base, past, tails)
        said = _say(model, record, {})
        return _Trained(model, said, score_prognoses(judge(said.prognoses, record.features, record.lives())))

    chosen, verdict = _chosen(train, candidate, last)
    card = model_card(chosen.model, chosen.scores) | {"promoted": verdict.promoted, "promotion": verdict.reason}
    card |= {"learned_because": why, "late_flights_not_learned_from": 0}
    return ModelUpdate(chosen.model, chosen.said.prognoses, card, digest.to_json(), chosen.said.scored)


class _Said(NamedTuple):
    """Prognoses of flights that had none, which flights have one now, and the keys of those that had one."""

    prognoses: pl.DataFrame
    scored: dict[str, ScoredFlights]
    stand: pl.DataFrame


def _say(model: Prognosis, record: FleetRecord, before: Mapping[str, ScoredFlights]) -> _Said:
    """What the folds of a model say about flights that are not, or not as they now are, among those scored before."""

    def say(component: str, track: Tracks) -> tuple[pl.DataFrame, ScoredFlights, pl.DataFrame]:
        told, new = scored(track, before.get(component))
        stand = track.keys.filter(~new).select(*PACK, "flight_id", pl.lit(component).alias("component"))
        return predict_by_fold(model, component, track, new), told, stand

    lived = record.tracks()
    said, told, stand = zip(*(say(c, lived[c]) for c in lived), strict=True)
    return _Said(pl.concat(said).sort("component", *IN_ORDER), dict(zip(lived, told, strict=True)), pl.concat(stand))


class _Trained(NamedTuple):
    """A base with what a fleet taught it, what its folds say, and how well."""

    model: Prognosis
    said: _Said
    scores: dict[str, float]


def _chosen(
    train: Callable[[Prognosis], _Trained], candidate: Prognosis, last: ModelUpdate | None
) -> tuple[_Trained, Verdict]:
    """The candidate, or what served until now where that says better."""
    new = train(candidate)
    if last is None:
        return new, Verdict(True, "no other model is in service")
    if inputs(last.model) != inputs(candidate):
        return new, Verdict(True, "the model in service reads other inputs and can't be asked")
    if same_base(candidate, last.model):
        return new, Verdict(True, "the base in service is the one the present code learns")
    old = train(last.model)
    verdict = promote(model_card(candidate, new.scores), model_card(last.model, old.scores))
    return (new if verdict.promoted else old), verdict


def _score_new(last: ModelUpdate, record: FleetRecord, late: int) -> ModelUpdate:
    """Score flights that are new or whose record has changed; `late` flights are not learned from yet."""
    said = _say(last.model, record, last.scored)
    kept = last.prognoses.join(said.stand, on=["component", *PACK, "flight_id"], how="semi")
    prognoses = pl.concat([kept, said.prognoses]).sort("component", *IN_ORDER)
    card = last.card | {"late_flights_not_learned_from": late}
    return replace(last, prognoses=prognoses, card=card, scored=said.scored)


def _learner(candidate: Prognosis, tails: list[str]) -> str:
    """Digest of what learns: the base, what is corrected of it, and whom the folds hold."""
    told = json.dumps([named(candidate).version, TERMS, tails])
    return hashlib.blake2b(told.encode(), digest_size=10).hexdigest()


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
