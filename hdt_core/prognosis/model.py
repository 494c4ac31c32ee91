"""Prognosis: how many flights are left, how sure, and how likely a message is by flight k, without any condition.

A gradient-boosted hazard learned from simulated lives is the prior; a fleet's own lives move the message's rule, the
hazard and the interval. What lies beyond the horizon of 300 flights is told as the horizon.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingClassifier

from hdt_core.prognosis.feature_rows import (
    INPUTS,
    PRIOR_RULES,
    FailureRule,
    Tracks,
    fleet_rows,
    learn_rule,
    simulated_rows,
    tracks,
)
from hdt_core.prognosis.hazard import (
    EDGES,
    event_by,
    events_ahead,
    fit_hazard,
    hazards,
    passage_hazards,
    quantile,
)  # fmt: skip
from hdt_core.prognosis.history import PASSAGE, PASSAGE_AHEAD, RISES
from hdt_core.prognosis.metrics import interval_score
from hdt_core.prognosis.recalibrate import NOMINAL, HazardCorrection, Levels, learn_correction, learn_levels
from hdt_core.records.keys import IN_ORDER

Array = NDArray[np.float64]

HORIZON = float(EDGES[-1])
_RESERVE = INPUTS.index("reserve_95")
_PASSAGE = [INPUTS.index(name) for name in PASSAGE[:-1]]
MEMBERS = 3
"""Models in the base."""
LEARN_EVERY, LEARN_ROWS = 4, 1_000
"""Of a life's flights one in so many corrects the base: neighbours say the same. Of a large fleet fewer still: what is
learned are a few numbers, and so many rows tell them."""
LEARN_FROM = 12
"""Failures on a fleet's record from which on its lives may correct the base: what fewer taught took more than it gave
on eight unseen fleets (docs/prognosis.md)."""
FOLDS = 5
LESSONS = ((False, False), (True, False), (False, True), (True, True))
"""Hazard correction and interval levels of a fleet's own lives, taken up or not; the simplest first."""
HELD = "out_of_fold"
PHYSICS_ALONE = frozenset({"CC"})
"""Components whose hazard is that of their first passage through the declared limit: the base learned lives of
exchangers, and a limit learned from the few units that failed first lies too low (docs/prognosis.md shows both)."""


@dataclass(frozen=True, slots=True)
class ComponentFit:
    """What one component's lives taught: the message's rule, the hazard's correction, the interval's levels."""

    rule: FailureRule
    correction: HazardCorrection = field(default_factory=HazardCorrection)
    levels: Levels = NOMINAL
    failures: int = 0
    lives: int = 0


Fits = dict[str, ComponentFit]
"""By component."""


@dataclass(frozen=True, slots=True)
class Fold:
    """Groups that are judged together by what the others taught."""

    held: tuple[str, ...]
    fits: Fits


@dataclass(frozen=True, slots=True)
class Prognosis:
    """A fitted prognosis model.

    Attributes
    ----------
    hazard : tuple of HistGradientBoostingClassifier
        The base: each learned from its own simulated fleets, their hazards averaged.
    base_levels : tuple of float
        Levels at which the distribution is told, from simulated lives held out.
    fits : dict of str to ComponentFit
        By component.
    version : str
        Digest of all the above.
    folds : tuple of Fold
        What judges each of the fleet's own tails; empty where the model was not learned from a fleet.
    """

    hazard: tuple[HistGradientBoostingClassifier, ...]
    base_levels: Levels
    fits: Fits = field(default_factory=dict)
    version: str = ""
    folds: tuple[Fold, ...] = ()


def fit_prognosis(features: pl.DataFrame, lives: pl.DataFrame, base: Prognosis) -> Prognosis:
    """Model for live use, from simulated lives and all of the fleet's own.

    Parameters
    ----------
    features : DataFrame
        operator, tail, flight_id, pack, departed_at and what there is of `LOSSES` and `ASKS` of `feature_rows`. May be
        empty.
    lives : DataFrame
        From `unit_lives.episodes`. May hold no failure.
    base : Prognosis
        What `fit_base` gave; it depends on no fleet.
    """
    return fit_tracks(base, {c: tracks(features, lives, c) for c in PRIOR_RULES})


def fit_tracks(base: Prognosis, lived: Mapping[str, Tracks], groups: Sequence[str] = (), by: str = "tail") -> Prognosis:
    """`base` with what all tracks of a fleet teach, and for each fold of `groups` with what all others do.

    Groups of which nothing is known yet have their fold too. Of `lived` one component is held at a time.
    """
    held = split_groups(groups)
    # no name for a track: it would be held while the next is cut
    return assemble(base, held, {c: fit_component(base, lived[c], c, held, by) for c in lived})


def split_groups(groups: Sequence[str]) -> list[tuple[str, ...]]:
    """Which groups are held out together."""
    return [tuple(sorted(groups)[k::FOLDS]) for k in range(min(FOLDS, len(groups)))]


def fit_component(
    base: Prognosis, track: Tracks, component: str, held: Sequence[tuple[str, ...]], by: str = "tail"
) -> list[ComponentFit]:
    """What all tracks teach, then for each fold what all but those `held` do.

    Of hazard correction and interval levels only what lessens the interval score of held-out groups is kept: all of
    them for live use, those of the other folds for a fold.
    """
    outside = [~track.keys[by].is_in(names).to_numpy() for names in held]
    fits = [_learn(base, track, component, ~track.mute & use) for use in (~track.mute, *outside)]
    if not held or component in PHYSICS_ALONE or fits[0].failures < LEARN_FROM:
        return fits
    scores = _lesson_scores(base, track, component, outside, fits[1:])
    left_out = [scores.sum(axis=0), *(scores.sum(axis=0) - own for own in scores)]
    kept = [LESSONS[int(np.argmin(s))] for s in left_out]
    untaught = untaught_levels(base, component)
    return [_keep_lessons(fit, untaught, *lessons) for fit, lessons in zip(fits, kept, strict=True)]


def _keep_lessons(fit: ComponentFit, untaught: Levels, corrected: bool, levelled: bool) -> ComponentFit:
    correction = fit.correction if corrected else HazardCorrection()
    return replace(fit, correction=correction, levels=fit.levels if levelled else untaught)


def untaught_levels(base: Prognosis, component: str) -> Levels:
    """Levels at which a component's distribution is reported before a fleet has taught any."""
    return NOMINAL if component in PHYSICS_ALONE else base.base_levels


def _hazards(base: Prognosis, component: str, features: Array) -> Array:
    """Hazard by the base, or by first passage; where no passage is known, by the base. (n, SPANS)"""
    if component not in PHYSICS_ALONE:
        return hazards(base.hazard, features)
    passage = passage_hazards(features[:, _PASSAGE], PASSAGE_AHEAD)
    unknown = np.isnan(passage).any(axis=1)
    passage[unknown] = hazards(base.hazard, features[unknown])
    return passage


def _lesson_scores(
    base: Prognosis,
    track: Tracks,
    component: str,
    outside: Sequence[NDArray[np.bool_]],
    fits: Sequence[ComponentFit],
) -> Array:
    """Interval score of each fold's held-out lives with each of `LESSONS`, summed over rows: fold by lesson.

    Lives count that ended in the message or outlived the horizon. A fold's own row decides nothing about that fold.
    """
    column = track.at[:, 1]
    judged = ~track.mute & (track.left >= 1) & (column >= 0) & (track.failed | (track.left >= HORIZON))
    every = _stride(judged)
    scores = np.zeros((len(fits), len(LESSONS)))
    for k, (use, fit) in enumerate(zip(outside, fits, strict=True)):
        rows = fleet_rows(track, fit.rule, judged & ~use & (column % every == 0))
        raw, left = _hazards(base, component, rows.features), np.minimum(rows.left, HORIZON)
        by = {False: event_by(raw), True: event_by(fit.correction(raw, rows.features[:, _RESERVE]))}
        for m, (corrected, levelled) in enumerate(LESSONS):
            low, _, high = fit.levels if levelled else untaught_levels(base, component)
            scores[k, m] = interval_score(left, quantile(by[corrected], low), quantile(by[corrected], high)).sum()
    return scores


def _stride(use: NDArray[np.bool_]) -> int:
    """Every how many flights of a life a row is taken, so that about `LEARN_ROWS` are."""
    return max(LEARN_EVERY, -(-int(use.sum()) // LEARN_ROWS))


def assemble(base: Prognosis, held: Sequence[tuple[str, ...]], fits: Mapping[str, Sequence[ComponentFit]]) -> Prognosis:
    """A model from what `fit_component` gave of each component."""
    own, *others = ({component: parts[k] for component, parts in fits.items()} for k in range(len(held) + 1))
    return named(base, own, tuple(Fold(*fold) for fold in zip(held, others, strict=True)))


def predict_prognosis(
    model: Prognosis, features: pl.DataFrame, lives: pl.DataFrame, split: str = "live"
) -> pl.DataFrame:
    """Prognoses for every flight of the features, from that flight and earlier ones.

    Returns
    -------
    DataFrame
        Columns of the contract's `prognoses`, one row a flight, pack and component; where the health is unknown so far
        the row is there and its values are null.
    """
    parts = [_predict(model, tracks(features, lives, c), model.fits[c], c, split) for c in PRIOR_RULES]
    return pl.concat(parts).sort("component", *IN_ORDER)


def out_of_fold(features: pl.DataFrame, lives: pl.DataFrame, base: Prognosis, by: str = "tail") -> pl.DataFrame:
    """Prognoses of each tail from a model that never saw that tail's own lives; the base saw simulated ones only.

    With `by="operator"` no life of the tail's whole operator was seen: what a new operator may expect.
    """
    lived = {c: tracks(features, lives, c) for c in PRIOR_RULES}
    model = fit_tracks(base, lived, features[by].unique().to_list(), by)
    return pl.concat(predict_by_fold(model, c, track, by=by) for c, track in lived.items()).sort("component", *IN_ORDER)


def predict_by_fold(
    model: Prognosis, component: str, track: Tracks, asked: NDArray[np.bool_] | None = None, by: str = "tail"
) -> pl.DataFrame:
    """A component's prognoses of all flights, or of those asked about, each group by the fold that never saw it."""
    asked = np.ones(len(track.at), bool) if asked is None else asked
    parts = [_predict(model, track, ComponentFit(PRIOR_RULES[component]), component, HELD, asked & False)]
    for fold in model.folds:
        rows = asked & track.keys[by].is_in(fold.held).to_numpy()
        parts.append(_predict(model, track, fold.fits[component], component, HELD, rows))
    return pl.concat(parts)


def fit_base() -> Prognosis:
    """Base learned from simulated lives alone: the same for every fleet, so it need be fitted once."""
    learned = tuple(fit_member(seed) for seed in range(MEMBERS))
    check = simulated_rows(MEMBERS, fleets=20)
    by = event_by(hazards(learned, check.features))
    return Prognosis(learned, learn_levels(by, check.left, check.failed, check.life, prior_lives=0.0))


def fit_member(seed: int, fleets: int = 50) -> HistGradientBoostingClassifier:
    """One model of a base, from its own simulated fleets."""
    rows = simulated_rows(seed, fleets)
    return fit_hazard(rows.features, rows.left, rows.failed, seed, (*RISES, 0))


def _learn(base: Prognosis, track: Tracks, component: str, use: NDArray[np.bool_]) -> ComponentFit:
    """The message's rule from the rows in `use`; where enough failed, the correction of the base and the levels."""
    rule = learn_rule(track, component, use)
    life, column = track.at.T
    use = use & (track.left >= 1) & (column >= 0)
    failures, lives = (int(np.unique(life[rows]).size) for rows in (use & track.failed, use))
    if component in PHYSICS_ALONE or failures < LEARN_FROM:
        return ComponentFit(rule, levels=untaught_levels(base, component), failures=failures, lives=lives)
    rows = fleet_rows(track, rule, use & (column % _stride(use) == 0))
    raw, reserve = _hazards(base, component, rows.features), rows.features[:, _RESERVE]
    correction = learn_correction(raw, reserve, rows.left, rows.failed, rows.life)
    by = event_by(correction(raw, reserve))
    levels = learn_levels(by, rows.left, rows.failed, rows.life, untaught_levels(base, component))
    return ComponentFit(rule, correction, levels, failures, lives)


def _predict(
    model: Prognosis,
    track: Tracks,
    fit: ComponentFit,
    component: str,
    split: str,
    asked: NDArray[np.bool_] | None = None,
) -> pl.DataFrame:
    asked = np.ones(len(track.at), bool) if asked is None else asked
    rows = fleet_rows(track, fit.rule, asked)
    by = event_by(fit.correction(_hazards(model, component, rows.features), rows.features[:, _RESERVE]))
    known = track.at[asked, 1] >= 0
    low, middle, high = (quantile(by, level) for level in fit.levels)
    numbers = {"rul_flights": middle, "rul_low": np.minimum(low, middle), "rul_high": np.maximum(high, middle)}
    numbers |= events_ahead(by)
    columns = [pl.Series(name, np.where(known, v, np.nan)).fill_nan(None) for name, v in numbers.items()]
    return track.keys.filter(asked).select(
        "operator", "tail", "flight_id", "pack", pl.lit(component).alias("component"), "departed_at", *columns,
        (columns[0] >= HORIZON).alias("beyond_horizon"),
        pl.lit(model.version).alias("model_version"), pl.lit(split).alias("split"),
    )  # fmt: skip


def named(base: Prognosis, fits: Fits | None = None, folds: tuple[Fold, ...] = ()) -> Prognosis:
    """`base` with these fits and folds, and the digest of all for a version."""
    fits = fits or {}
    parts = [("", fits), *((" ".join(fold.held), fold.fits) for fold in folds)]
    learned: dict[str, Any] = {
        name: {c: [repr(f.rule), f.correction.weights, f.levels] for c, f in part.items()} for name, part in parts
    }
    trees = [float(np.sum(m.train_score_)) if len(m.train_score_) else m.n_iter_ for m in base.hazard]
    digest = hashlib.sha256(json.dumps([learned, base.base_levels, trees], sort_keys=True).encode()).hexdigest()[:12]
    return Prognosis(base.hazard, base.base_levels, fits, digest, folds)
