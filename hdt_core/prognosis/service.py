"""The model of each month, its card, and the prognoses of its flights.

Flights of a month are predicted by the model fitted to the record of when the month began, in a backfill as in a
nightly run, so a row holds the prediction of that night. Later fits do not rewrite it. A month's model is fitted again
where its training data changed materially (`training_digests`): the aircraft's models, the base, or many late flights
of earlier months. Few late flights are predicted at once by their own month's model and enter training from the next
month on.

A new base and the one in service predict the same flights out of fold. Both are corrected by the fleet's own lives, so
only the bases compete. The base in service depends on the one before it: the one thing here that does not follow from
the record.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import date
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from hdt_core.components import Limit
from hdt_core.margin.margin import MessageRule
from hdt_core.prognosis.choices import NO_WASHES, forecast_choices
from hdt_core.prognosis.feature_rows import (
    PRIOR_RULES,
    FailureRule,
    Tracks,
    last_rows,
    level_of,
    tracks,
    tracks_as_of,
)
from hdt_core.prognosis.fleet_record import (
    FleetRecord,
    ScoredFlights,
    TrainingDigest,
    flights_not_learned,
    month_of,
    retraining_reason,
    score_months,
    start_of,
    training_digests,
)
from hdt_core.prognosis.metrics import join_outcomes, score_prognoses
from hdt_core.prognosis.model import (
    ComponentFit,
    Fits,
    Fold,
    Prognosis,
    assemble,
    fit_component,
    predict_by_fold,
    predict_from,
    split_tails,
    with_version,
)
from hdt_core.prognosis.recalibrate import HazardCorrection
from hdt_core.records.keys import IN_ORDER, PACK

Card = dict[str, Any]


def to_parts(base: Prognosis) -> dict[str, Any]:
    """Return the base as a dict of scikit-learn objects and numbers, which skops stores without custom types."""
    return {"hazard": list(base.hazard), "base_levels": list(base.base_levels)}


def from_parts(parts: dict[str, Any]) -> Prognosis:
    """Build a base from the result of `to_parts`."""
    low, middle, high = parts["base_levels"]
    return Prognosis(tuple(parts["hazard"]), (low, middle, high))


def fits_to_json(model: Prognosis) -> dict[str, Any]:
    """Return a model's fits to a fleet as JSON types."""
    folds = [{"held": list(fold.tails), "fits": _plain(fold.fits)} for fold in model.folds]
    return {"version": model.version, "fits": _plain(model.fits), "folds": folds}


def with_fits(base: Prognosis, fields: dict[str, Any]) -> Prognosis:
    """Return a base with the fits of `fits_to_json`."""
    folds = tuple(Fold(tuple(fold["held"]), _fits(fold["fits"])) for fold in fields["folds"])
    return replace(base, fits=_fits(fields["fits"]), version=fields["version"], folds=folds)


def _plain(fits: Fits) -> dict[str, Any]:
    return {component: asdict(fit) for component, fit in fits.items()}


def _fits(plain: dict[str, Any]) -> Fits:
    return {
        component: ComponentFit(
            _rule(fit["rule"] if "rule" in fit else fit["says"]),  # its name in homes made until November 2026
            HazardCorrection(tuple(fit["correction"]["weights"])),
            (fit["levels"][0], fit["levels"][1], fit["levels"][2]),
            fit["failures"],
            fit["lives"],
        )
        for component, fit in plain.items()
    }


def _rule(plain: dict[str, Any]) -> FailureRule:
    return Limit(**plain) if "mean" in plain else {name: MessageRule(**rule) for name, rule in plain.items()}


def model_card(model: Prognosis, scores: dict[str, float] | None = None) -> Card:
    """Describe a model: its outputs, training data and out-of-fold scores.

    Parameters
    ----------
    model : Prognosis
        Fitted model.
    scores : dict, optional
        Out-of-fold scores, as from `metrics.score_prognoses`.
    """
    return {
        "model_version": model.version,
        "says": (
            "rul_flights, rul_low, rul_high: 50, 5 and 95 % points of the flights left until the message, without any "
            "condition; 300 stands for 300 or more; p_event_50: probability of the message within 50 flights"
        ),
        "learned_from": "simulated lives (base); the fleet's own failed and censored lives (rule, hazard, interval)",
        "failures": {component: fit.failures for component, fit in model.fits.items()},
        "lives": {component: fit.lives for component, fit in model.fits.items()},
        "message": {component: fit["rule"] for component, fit in _plain(model.fits).items()},
        "not_for": "removals for other reasons than the message; components without a health track",
        "scores": scores or {},
    }


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether a model goes into service, and why."""

    promoted: bool
    reason: str


def promote(candidate: Card, in_service: Card | None, tolerance: float = 0.02) -> Verdict:
    """Decide whether a model replaces the one in service: only if it scores no worse.

    Both cards must have been scored on the same flights; the figures compared are the interval score and the Brier
    score, which can't be improved by hedging. A rise of more than `tolerance` (a share) in either is worse.
    """
    if in_service is None or not in_service.get("scores"):
        return Verdict(True, "no scored model is in service")
    for name in ("interval_score_flights", "brier"):
        candidate_score = candidate["scores"].get(name)
        service_score = in_service["scores"].get(name)
        if service_score is None:
            continue
        if candidate_score is None:
            return Verdict(False, f"{name} of the candidate is unknown, {service_score:.4g} is in service")
        if candidate_score > service_score * (1.0 + tolerance):
            return Verdict(False, f"{name} is {candidate_score:.4g}, worse than {service_score:.4g} in service")
    return Verdict(True, "no score is worse than in service")


@dataclass(frozen=True, slots=True)
class MonthModel:
    """The model of a month.

    Attributes
    ----------
    model : Prognosis
        The base with fits to the record of when the month began.
    card : dict
        The model's card; that of the newest month has the scores of all flights before.
    digest : TrainingDigest
        Its training data.
    scored_flights : dict
        Flights of the month that have a prognosis by it.
    service : dict
        Reasons for its training and for its base: history of this home, which follows from no record.
    """

    model: Prognosis
    card: Card
    digest: TrainingDigest
    scored_flights: ScoredFlights
    service: dict[str, Any]


@dataclass(frozen=True, slots=True)
class ModelUpdate:
    """Models by month with flights, the out-of-fold prognoses of all flights, and the choices after the last."""

    months: dict[date, MonthModel]
    prognoses: pl.DataFrame
    choices: pl.DataFrame = field(default_factory=pl.DataFrame)

    @property
    def newest(self) -> MonthModel:
        """The model of the newest month."""
        return self.months[max(self.months)]


def update_model(candidate: Prognosis, last: ModelUpdate | None, record: FleetRecord, design: str = "") -> ModelUpdate:
    """Fit models of new months to the record before each, and predict flights that have no prognosis yet.

    Parameters
    ----------
    candidate : Prognosis
        Base as fitted by the present code. The one in service stays where it scores better.
    last : ModelUpdate, optional
        Models in service; None on the first night.
    record : FleetRecord
        The whole record.
    design : str
        Digest of what features depend on besides the record.
    """
    last = last if last is not None and last.months else None
    last_months = last.months if last is not None else {}
    digests = training_digests(record, with_version(candidate).version, design)
    last_digests = {month: model.digest for month, model in last_months.items()}
    reasons = {month: retraining_reason(now, last_digests.get(month)) for month, now in digests.items()}
    tails = {month: digests[month].tails for month, reason in reasons.items() if reason}
    if last is None or any(last_digests[m].base != digests[m].base for m in last_digests.keys() & digests.keys()):
        forecast, verdict = _choose(candidate, last, record, tails)
    else:
        verdict = Verdict(last.newest.service["promoted"], last.newest.service["promotion"])
        forecast = _forecast(last.newest.model, record, tails, last)
    scores = _scores(forecast.prognoses, record) if tails else last.newest.card["scores"] if last is not None else {}
    months = {}
    for month, now in digests.items():
        digest = now if reasons[month] else last_digests[month]
        service = {
            "promoted": verdict.promoted,
            "promotion": verdict.reason,
            "learned_because": reasons[month] or last_months[month].service["learned_because"],
            "late_flights_not_learned_from": flights_not_learned(now, digest),
        }
        card = model_card(forecast.models[month], scores if month == max(digests) else None)
        months[month] = MonthModel(forecast.models[month], card, digest, forecast.scored_flights[month], service)
    return ModelUpdate(months, forecast.prognoses, forecast.choices)


class _Forecast(NamedTuple):
    """Models by month, their flights, the prognoses of all flights, and the choices after the last."""

    models: dict[date, Prognosis]
    scored_flights: dict[date, ScoredFlights]
    prognoses: pl.DataFrame
    choices: pl.DataFrame


def _forecast(
    base: Prognosis, record: FleetRecord, tails: Mapping[date, list[str]], last: ModelUpdate | None = None
) -> _Forecast:
    """Fit a base's models of the months in `tails`, by fold of these aircraft; predict flights without a prognosis."""
    last_months = last.months if last is not None else {}
    lives = {month: record.as_of(start_of(month)).lives() for month in tails}
    folds = {month: split_tails(tails[month]) for month in tails}
    models = {month: last_months[month].model for month in record.months() if month not in tails}
    fits: dict[date, dict[str, list[ComponentFit]]] = {month: {} for month in tails}
    scored_flights: dict[date, ScoredFlights] = {month: {} for month in record.months()}
    choices = [pl.DataFrame()]

    def predict_component(component: str, track: Tracks) -> tuple[pl.DataFrame, pl.DataFrame]:
        flights, is_new = score_months(track, component, {m: last_months[m].scored_flights for m in last_months})
        month_at = month_of(track.keys["departed_at"])
        is_new |= month_at.is_in(list(tails)).to_numpy()
        parts = [predict_by_fold(base, component, track, is_new & False)]
        last_flights = last_rows(track)
        for month in scored_flights:
            scored_flights[month] |= flights.get(month, {})
            if month in tails:
                past_track = tracks_as_of(track, start_of(month), lives[month], component)
                fits[month][component] = fit_component(base, past_track, component, folds[month])
            is_of_month = (month_at == month).to_numpy()
            is_selected = is_new & is_of_month
            units = last_flights[is_of_month[last_flights]]
            if not (is_selected.any() or units.size):
                continue
            model = models.get(month) or assemble(base, folds[month], {component: fits[month][component]})
            parts.append(predict_by_fold(model, component, track, is_selected))
            predict = partial(predict_from, model, component, track, units)
            loss = level_of(track)[units]
            washes = record.washes.get(component, NO_WASHES)
            choices.append(forecast_choices(track.keys[units], loss, component, washes, predict))
        old_keys = track.keys.filter(~is_new).select(*PACK, "flight_id", pl.lit(component).alias("component"))
        return pl.concat(parts), old_keys

    all_lives = record.lives()
    units = record.units()
    by_component = (predict_component(c, tracks(record.features, all_lives, c, units)) for c in PRIOR_RULES)
    predictions, old_keys = zip(*by_component, strict=True)
    models |= {month: assemble(base, folds[month], fits[month]) for month in tails}
    new_prognoses = pl.concat(predictions).with_columns(_version_of(models))
    old_prognoses = (
        new_prognoses.clear()
        if last is None
        else last.prognoses.join(pl.concat(old_keys), on=["component", *PACK, "flight_id"], how="semi")
    )
    prognoses = pl.concat([old_prognoses, new_prognoses]).sort("component", *IN_ORDER)
    return _Forecast(models, scored_flights, prognoses, pl.concat(choices, how="diagonal"))


def _version_of(models: Mapping[date, Prognosis]) -> pl.Expr:
    """Return the version of the model of a flight's month."""
    month = pl.col("departed_at").dt.month_start().dt.date()
    versions = [models[m].version for m in models]
    return month.replace_strict(list(models), versions, return_dtype=pl.String).alias("model_version")


def _scores(prognoses: pl.DataFrame, record: FleetRecord) -> dict[str, float]:
    """Score prognoses of the flights before the newest month by outcomes on record when it began."""
    moment = start_of(max(record.months()))
    past = record.as_of(moment)
    return score_prognoses(join_outcomes(prognoses.filter(pl.col("departed_at") < moment), past.features, past.lives()))


def _choose(
    candidate: Prognosis, last: ModelUpdate | None, record: FleetRecord, tails: Mapping[date, list[str]]
) -> tuple[_Forecast, Verdict]:
    """Forecast by the candidate, or by the base in service where that scores better; all months are fitted anew."""
    challenger = _forecast(candidate, record, tails)
    if last is None:
        return challenger, Verdict(True, "no other model is in service")
    base = last.newest.model
    if n_inputs(base) != n_inputs(candidate):
        return challenger, Verdict(True, "the model in service reads other inputs and can't be asked")
    if same_base(candidate, base):
        return challenger, Verdict(True, "the base in service is the one the present code learns")
    champion = _forecast(base, record, tails)
    new_card, old_card = (
        model_card(f.models[max(tails)], _scores(f.prognoses, record)) for f in (challenger, champion)
    )
    verdict = promote(new_card, old_card)
    return (challenger if verdict.promoted else champion), verdict


def same_base(first: Prognosis, second: Prognosis) -> bool:
    """Check whether two models have the same base: their hazards agree at a few probe points."""
    if first.base_levels != second.base_levels or len(first.hazard) != len(second.hazard):
        return False
    probe = np.linspace(0.0, 1.0, 7)[:, None] * np.ones(n_inputs(first))
    return all(
        np.allclose(a.predict_proba(probe), b.predict_proba(probe))
        for a, b in zip(first.hazard, second.hazard, strict=True)
    )


def n_inputs(model: Prognosis) -> int:
    """Return the number of the hazard's input columns."""
    return int(model.hazard[0].n_features_in_)
