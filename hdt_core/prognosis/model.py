"""Predict remaining flights with an interval, and the probability of a message within k flights, unconditionally.

A gradient-boosted hazard fitted to simulated lives is the prior; a fleet's own lives update the message's rule, the
hazard and the interval. Predictions end at the horizon of 300 flights.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from hdt_core.prognosis.feature_rows import (
    INPUTS,
    PRIOR_RULES,
    FailureRule,
    Tracks,
    fleet_rows,
    learn_rule,
    with_loss,
)
from hdt_core.prognosis.hazard import EDGES, event_by, events_ahead, hazards, passage_hazards, quantile
from hdt_core.prognosis.history import PASSAGE, PASSAGE_AHEAD, Index
from hdt_core.prognosis.metrics import interval_score
from hdt_core.prognosis.recalibrate import NOMINAL, HazardCorrection, Levels, learn_correction, learn_levels
from hdt_core.robust import Array

if TYPE_CHECKING:  # scikit-learn takes a second to load
    from sklearn.ensemble import HistGradientBoostingClassifier

HORIZON = float(EDGES[-1])
_RESERVE = INPUTS.index("reserve_95")
_PASSAGE = [INPUTS.index(name) for name in PASSAGE[:-1]]
LEARN_EVERY, LEARN_ROWS = 4, 1_000
"""Every so many flights of a life correct the base, for neighbours are nearly equal; at most about so many rows in all,
which determine the few parameters."""
LEARN_FROM = 12
"""Failures on a fleet's record from which on its lives may correct the base: with fewer, scores on eight test fleets
got worse (docs/prognosis.md)."""
FOLDS = 5
LESSONS = ((False, False), (True, False), (False, True), (True, True))
"""Whether to use hazard correction and interval levels of a fleet's own lives; the simplest first."""
OUT_OF_FOLD = "out_of_fold"
PHYSICS_ALONE = frozenset({"CC"})
"""Components whose hazard is that of their first passage through the declared limit: the base was fitted to lives of
exchangers, and a limit estimated from the few units that failed first lies too low (docs/prognosis.md shows both)."""


@dataclass(frozen=True, slots=True)
class ComponentFit:
    """Estimates from one component's lives: the message's rule, the hazard's correction, the interval's levels."""

    rule: FailureRule
    correction: HazardCorrection = field(default_factory=HazardCorrection)
    levels: Levels = NOMINAL
    failures: int = 0
    lives: int = 0


Fits = dict[str, ComponentFit]
"""By component."""


@dataclass(frozen=True, slots=True)
class Fold:
    """Tails that are held out together, and the fits from all others."""

    tails: tuple[str, ...]
    fits: Fits


@dataclass(frozen=True, slots=True)
class Prognosis:
    """A fitted prognosis model.

    Attributes
    ----------
    hazard : tuple of HistGradientBoostingClassifier
        The base: each fitted to its own simulated fleets, their hazards averaged.
    base_levels : tuple of float
        Levels of the reported quantiles, from held-out simulated lives.
    fits : dict of str to ComponentFit
        By component.
    version : str
        Digest of all the above.
    folds : tuple of Fold
        Fits for each of the fleet's own tails; empty for a model that is not fitted to a fleet.
    """

    hazard: "tuple[HistGradientBoostingClassifier, ...]"
    base_levels: Levels
    fits: Fits = field(default_factory=dict)
    version: str = ""
    folds: tuple[Fold, ...] = ()


def split_tails(tails: Sequence[str]) -> list[tuple[str, ...]]:
    """Assign tails to folds."""
    return [tuple(sorted(tails)[k::FOLDS]) for k in range(min(FOLDS, len(tails)))]


def fit_component(
    base: Prognosis, track: Tracks, component: str, folds: Sequence[tuple[str, ...]]
) -> list[ComponentFit]:
    """Fit all tracks, then for each of `folds` all tracks but its own.

    Hazard correction and interval levels are used only where they lower the interval score of held-out tails: of all
    tails for live use, of the other folds for a fold.
    """
    training = [~track.keys["tail"].is_in(tails).to_numpy() for tails in folds]
    fits = [_learn(base, track, component, ~track.mute & use) for use in (~track.mute, *training)]
    if not folds or component in PHYSICS_ALONE or fits[0].failures < LEARN_FROM:
        return fits
    scores = _lesson_scores(base, track, component, training, fits[1:])
    left_out = [scores.sum(axis=0), *(scores.sum(axis=0) - fold_scores for fold_scores in scores)]
    best_lessons = [LESSONS[int(np.argmin(s))] for s in left_out]
    default_levels = prior_levels(base, component)
    return [_keep_lessons(fit, default_levels, *lessons) for fit, lessons in zip(fits, best_lessons, strict=True)]


def _keep_lessons(fit: ComponentFit, default_levels: Levels, use_correction: bool, use_levels: bool) -> ComponentFit:
    correction = fit.correction if use_correction else HazardCorrection()
    return replace(fit, correction=correction, levels=fit.levels if use_levels else default_levels)


def prior_levels(base: Prognosis, component: str) -> Levels:
    """Return a component's quantile levels without data of a fleet."""
    return NOMINAL if component in PHYSICS_ALONE else base.base_levels


def _hazards(base: Prognosis, component: str, features: Array) -> Array:
    """Predict the hazard by the base, or by first passage where it is finite. (n, SPANS)"""
    if component not in PHYSICS_ALONE:
        return hazards(base.hazard, features)
    passage = passage_hazards(features[:, _PASSAGE], PASSAGE_AHEAD)
    is_missing = np.isnan(passage).any(axis=1)
    passage[is_missing] = hazards(base.hazard, features[is_missing])
    return passage


def _lesson_scores(
    base: Prognosis,
    track: Tracks,
    component: str,
    training: Sequence[Array],
    fits: Sequence[ComponentFit],
) -> Array:
    """Sum the interval score of each fold's held-out lives with each of `LESSONS`: fold by lesson.

    Lives count that ended in the message or outlived the horizon. A fold's own row is not used to choose its lessons.
    """
    column = track.at[:, 1]
    is_scored = ~track.mute & (track.remaining >= 1) & (column >= 0) & (track.failed | (track.remaining >= HORIZON))
    stride = _stride(is_scored)
    scores = np.zeros((len(fits), len(LESSONS)))
    for k, (use, fit) in enumerate(zip(training, fits, strict=True)):
        rows = fleet_rows(track, fit.rule, is_scored & ~use & (column % stride == 0))
        raw = _hazards(base, component, rows.features)
        remaining = np.minimum(rows.remaining, HORIZON)
        by = {False: event_by(raw), True: event_by(fit.correction(raw, rows.features[:, _RESERVE]))}
        for m, (use_correction, use_levels) in enumerate(LESSONS):
            low, _, high = fit.levels if use_levels else prior_levels(base, component)
            low_flights, high_flights = (quantile(by[use_correction], level) for level in (low, high))
            scores[k, m] = interval_score(remaining, low_flights, high_flights).sum()
    return scores


def _stride(use: Array) -> int:
    """Return the stride over a life's flights that gives about `LEARN_ROWS` rows."""
    return max(LEARN_EVERY, -(-int(use.sum()) // LEARN_ROWS))


def assemble(
    base: Prognosis, folds: Sequence[tuple[str, ...]], fits: Mapping[str, Sequence[ComponentFit]]
) -> Prognosis:
    """Build a model from each component's `fit_component`."""
    fleet_fits, *fold_fits = ({component: parts[k] for component, parts in fits.items()} for k in range(len(folds) + 1))
    return with_version(base, fleet_fits, tuple(Fold(*fold) for fold in zip(folds, fold_fits, strict=True)))


def predict_by_fold(model: Prognosis, component: str, track: Tracks, is_selected: Array) -> pl.DataFrame:
    """Predict the selected flights of a component, each tail by the fold that excludes it.

    Returns
    -------
    DataFrame
        Columns of the contract's `prognoses`, one row a flight and pack; where the health is unknown so far the row is
        there and its values are null.
    """
    parts = [_predict(model, track, ComponentFit(PRIOR_RULES[component]), component, is_selected & False)]
    for fold in model.folds:
        is_of_fold = is_selected & track.keys["tail"].is_in(fold.tails).to_numpy()
        parts.append(_predict(model, track, fold.fits[component], component, is_of_fold))
    return pl.concat(parts)


def predict_from(
    model: Prognosis, component: str, track: Tracks, units: Index, numbers: Index, losses: Array
) -> pl.DataFrame:
    """Predict some of the rows `units` of a track, by number, from other losses, each tail by its fold."""
    changed = with_loss(track, units[numbers], losses)
    return predict_by_fold(model, component, changed, np.ones(len(numbers), bool))


def _learn(base: Prognosis, track: Tracks, component: str, use: Array) -> ComponentFit:
    """Estimate the message's rule from the rows in `use` and, with enough failures, base correction and levels."""
    rule = learn_rule(track, component, use)
    life, column = track.at.T
    use = use & (track.remaining >= 1) & (column >= 0)
    failures, lives = (int(np.unique(life[rows]).size) for rows in (use & track.failed, use))
    if component in PHYSICS_ALONE or failures < LEARN_FROM:
        return ComponentFit(rule, levels=prior_levels(base, component), failures=failures, lives=lives)
    rows = fleet_rows(track, rule, use & (column % _stride(use) == 0))
    raw = _hazards(base, component, rows.features)
    reserve = rows.features[:, _RESERVE]
    correction = learn_correction(raw, reserve, rows.remaining, rows.failed, rows.life)
    by = event_by(correction(raw, reserve))
    levels = learn_levels(by, rows.remaining, rows.failed, rows.life, prior_levels(base, component))
    return ComponentFit(rule, correction, levels, failures, lives)


def _predict(model: Prognosis, track: Tracks, fit: ComponentFit, component: str, is_selected: Array) -> pl.DataFrame:
    """Predict the selected flights of a component by one fit."""
    rows = fleet_rows(track, fit.rule, is_selected)
    by = event_by(fit.correction(_hazards(model, component, rows.features), rows.features[:, _RESERVE]))
    is_known = track.at[is_selected, 1] >= 0
    low, middle, high = (quantile(by, level) for level in fit.levels)
    numbers = {"rul_flights": middle, "rul_low": np.minimum(low, middle), "rul_high": np.maximum(high, middle)}
    numbers |= events_ahead(by)
    columns = [pl.Series(name, np.where(is_known, v, np.nan)).fill_nan(None) for name, v in numbers.items()]
    return track.keys.filter(is_selected).select(
        "operator", "tail", "flight_id", "pack", pl.lit(component).alias("component"), "departed_at", *columns,
        (columns[0] >= HORIZON).alias("beyond_horizon"),
        pl.lit(model.version).alias("model_version"), pl.lit(OUT_OF_FOLD).alias("split"),
    )  # fmt: skip


def with_version(base: Prognosis, fits: Fits | None = None, folds: tuple[Fold, ...] = ()) -> Prognosis:
    """Return `base` with these fits and folds, and the digest of all as version."""
    fits = fits or {}
    parts = [("", fits), *((" ".join(fold.tails), fold.fits) for fold in folds)]
    content: dict[str, Any] = {
        name: {c: [repr(f.rule), f.correction.weights, f.levels] for c, f in part.items()} for name, part in parts
    }
    trees = [float(np.sum(m.train_score_)) if len(m.train_score_) else m.n_iter_ for m in base.hazard]
    digest = hashlib.sha256(json.dumps([content, base.base_levels, trees], sort_keys=True).encode()).hexdigest()[:12]
    return Prognosis(base.hazard, base.base_levels, fits, digest, folds)
