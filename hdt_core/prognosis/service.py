"""The model of each month, and the prognoses of its flights.

Flights of a month are scored by the model that learned from what was on record when the month began, in a backfill as
in a nightly run, so what a row holds is what was foretold, or would have been, on that night. Later learning does not
rewrite it. A month's model learns again where what it learned from is materially another (`training_digest`): where the
aircraft's models or the base are, or where many flights of the months before it came late. Few late flights are scored
at once, by their own month's model, and count from the next month on.

A newly learned base and the one in service are asked about the same flights, each tail judged by what the others
taught, so neither can have learned its own answers. The fleet's own lives are taken up by either; only what was learned
before any fleet was seen competes. Which base serves depends on which served before: the one thing here that does not
follow from the record.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from hdt_core.prognosis.feature_rows import Tracks, tracks_before
from hdt_core.prognosis.fleet_record import FleetRecord, ScoredFlights, month_of, score_months, start_of
from hdt_core.prognosis.metrics import judge, score_prognoses
from hdt_core.prognosis.model import (
    ComponentFit,
    Prognosis,
    assemble,
    fit_component,
    named,
    predict_by_fold,
    split_groups,
)
from hdt_core.prognosis.model_card import Card, Verdict, model_card, promote
from hdt_core.prognosis.training_digest import TrainingDigest, flights_not_learned, training_digests, why_learn
from hdt_core.records.keys import IN_ORDER, PACK


@dataclass(frozen=True, slots=True)
class MonthModel:
    """The model of a month.

    Attributes
    ----------
    model : Prognosis
        The base, and what was on record when the month began taught it.
    card : dict
        What a reader must know of it; of the newest month's with the scores of all flights before.
    digest : TrainingDigest
        What it learned from.
    scored : dict
        Which flights of the month it has scored.
    service : dict
        Why it learned and why its base serves: what happened in this home, and follows from no record.
    """

    model: Prognosis
    card: Card
    digest: TrainingDigest
    scored: ScoredFlights
    service: dict[str, Any]


@dataclass(frozen=True, slots=True)
class ModelUpdate:
    """The model of each month that has flights, and the out-of-fold prognoses of all of them."""

    months: dict[date, MonthModel]
    prognoses: pl.DataFrame

    @property
    def newest(self) -> MonthModel:
        """The model of the newest month."""
        return self.months[max(self.months)]


def update_model(candidate: Prognosis, last: ModelUpdate | None, record: FleetRecord, design: str = "") -> ModelUpdate:
    """Learn the models of new months from the record before each, and score the flights that have no prognosis yet.

    Parameters
    ----------
    candidate : Prognosis
        Base as learned by the present code. The one in service stays where it does better.
    last : ModelUpdate, optional
        What served until now; None on the first night.
    record : FleetRecord
        All that is on record.
    design : str
        Digest of what features follow from beside the record.
    """
    last = last if last is not None and last.months else None
    served = last.months if last is not None else {}
    digests = training_digests(record, named(candidate).version, design)
    reasons = {m: why_learn(now, served[m].digest if m in served else None) for m, now in digests.items()}
    tails = {month: digests[month].tails for month, why in reasons.items() if why}
    if last is None or any(served[m].digest.base != digests[m].base for m in served.keys() & digests.keys()):
        forecast, verdict = _choose(candidate, last, record, tails)
    else:
        verdict = Verdict(last.newest.service["promoted"], last.newest.service["promotion"])
        forecast = _forecast(last.newest.model, record, tails, last)
    scores = _scores(forecast.prognoses, record) if tails else last.newest.card["scores"] if last is not None else {}
    months = {}
    for month, now in digests.items():
        digest = now if reasons[month] else served[month].digest
        service = {
            "promoted": verdict.promoted,
            "promotion": verdict.reason,
            "learned_because": reasons[month] or served[month].service["learned_because"],
            "late_flights_not_learned_from": flights_not_learned(now, digest),
        }
        card = model_card(forecast.models[month], scores if month == max(digests) else None)
        months[month] = MonthModel(forecast.models[month], card, digest, forecast.scored[month], service)
    return ModelUpdate(months, forecast.prognoses)


class _Forecast(NamedTuple):
    """Models by month, the flights that they scored, and the prognoses of all flights."""

    models: dict[date, Prognosis]
    scored: dict[date, ScoredFlights]
    prognoses: pl.DataFrame


def _forecast(
    base: Prognosis, record: FleetRecord, tails: Mapping[date, list[str]], last: ModelUpdate | None = None
) -> _Forecast:
    """Learn a base's models of the months in `tails`, by fold of these aircraft; score what has no prognosis."""
    served = last.months if last is not None else {}
    lives = {month: record.before(start_of(month)).lives() for month in tails}
    held = {month: split_groups(tails[month]) for month in tails}
    models = {month: served[month].model for month in record.months() if month not in tails}
    fits: dict[date, dict[str, list[ComponentFit]]] = {month: {} for month in tails}
    scored: dict[date, ScoredFlights] = {month: {} for month in record.months()}

    def foretell(component: str, track: Tracks) -> tuple[pl.DataFrame, pl.DataFrame]:
        flights, new = score_months(track, component, {m: served[m].scored for m in served})
        month_at = month_of(track.keys["departed_at"])
        new |= month_at.is_in(list(tails)).to_numpy()
        parts = [predict_by_fold(base, component, track, new & False)]
        for month in scored:
            scored[month] |= flights.get(month, {})
            if month in tails:
                known = tracks_before(track, start_of(month), lives[month], component)
                fits[month][component] = fit_component(base, known, component, held[month])
            asked = new & (month_at == month).to_numpy()
            if asked.any():
                model = models.get(month) or assemble(base, held[month], {component: fits[month][component]})
                parts.append(predict_by_fold(model, component, track, asked))
        stand = track.keys.filter(~new).select(*PACK, "flight_id", pl.lit(component).alias("component"))
        return pl.concat(parts), stand

    lived = record.tracks()
    made, stand = zip(*(foretell(c, lived[c]) for c in lived), strict=True)
    models |= {month: assemble(base, held[month], fits[month]) for month in tails}
    said = pl.concat(made).with_columns(_version_of(models))
    kept = (
        said.clear()
        if last is None
        else last.prognoses.join(pl.concat(stand), on=["component", *PACK, "flight_id"], how="semi")
    )
    return _Forecast(models, scored, pl.concat([kept, said]).sort("component", *IN_ORDER))


def _version_of(models: Mapping[date, Prognosis]) -> pl.Expr:
    """The version of the model of a flight's month."""
    month = pl.col("departed_at").dt.month_start().dt.date()
    versions = [models[m].version for m in models]
    return month.replace_strict(list(models), versions, return_dtype=pl.String).alias("model_version")


def _scores(prognoses: pl.DataFrame, record: FleetRecord) -> dict[str, float]:
    """How well the flights before the newest month were foretold, by what was on record when it began."""
    moment = start_of(max(record.months()))
    past = record.before(moment)
    return score_prognoses(judge(prognoses.filter(pl.col("departed_at") < moment), past.features, past.lives()))


def _choose(
    candidate: Prognosis, last: ModelUpdate | None, record: FleetRecord, tails: Mapping[date, list[str]]
) -> tuple[_Forecast, Verdict]:
    """Forecast by the candidate, or by the base in service where that does better; all months learn anew."""
    new = _forecast(candidate, record, tails)
    if last is None:
        return new, Verdict(True, "no other model is in service")
    base = last.newest.model
    if inputs(base) != inputs(candidate):
        return new, Verdict(True, "the model in service reads other inputs and can't be asked")
    if same_base(candidate, base):
        return new, Verdict(True, "the base in service is the one the present code learns")
    old = _forecast(base, record, tails)
    new_card, old_card = (model_card(f.models[max(tails)], _scores(f.prognoses, record)) for f in (new, old))
    verdict = promote(new_card, old_card)
    return (new if verdict.promoted else old), verdict


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
