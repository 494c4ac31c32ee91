"""The prognosis layer on any record of lives: causal features of a health track, hazard, conformal interval levels.

Features, hazard and levels are those that the exchangers get (`history`, `hazard`, `recalibrate`); a recipe brings its
health track and what its unit is asked to do.
"""

from dataclasses import dataclass

import numpy as np
from sklearn.ensemble import HistGradientBoostingClassifier

from benchmarks.real.recipe import Array, Flags, Index
from hdt_core.prognosis.hazard import EDGES, SPANS, event_by, fit_hazard, hazards, quantile
from hdt_core.prognosis.history import FEATURES, THERMAL, Panel, feature_rows, record_rows
from hdt_core.prognosis.recalibrate import NOMINAL, Levels, learn_levels

WIDE = (0.025, 0.5, 0.975)
"""Levels of a 95 % interval, which some publish."""
SAMPLES, CUTS = 200_000, 20
"""Of (row, span) a model is fitted to; cuts of each life that levels are learned from."""


@dataclass(frozen=True, slots=True)
class Rows:
    """One row a unit and cycle: what is known by then, and cycles until its end."""

    x: Array
    left: Array
    unit: Index
    fold: Index
    """Rows of one fold are foretold by models that saw none of it."""

    def of(self, which: Flags | Index) -> "Rows":
        """Some of the rows."""
        return Rows(self.x[which], self.left[which], self.unit[which], self.fold[which])


@dataclass(frozen=True, slots=True)
class Foretold:
    """Forecasts of some rows: P(end within `EDGES` cycles), the 90 % interval and the 95 % interval."""

    by: Array
    low: Array
    high: Array
    wide: tuple[Array, Array]


def history_features(loss: Array, unit: Index, cycle: Index, limit: float) -> Array:
    """The layer's features of one health track: 0 as new, units end about `limit`. (n, p)"""
    level = np.full((unit.max() + 1, cycle.max() + 1), np.nan)
    level[unit, cycle] = loss
    age = np.broadcast_to(np.arange(level.shape[1], dtype=float), level.shape)
    ratio = np.log1p(-np.minimum(level, 0.95))
    unknown = np.full_like(level, np.nan)
    panel = Panel(level, np.full_like(level, 0.1), age, ratio, unknown, unknown, unknown, unknown)
    # nothing is asked that differs from cycle to cycle: a unit ends at a limit, as a compressor does
    critical = np.full_like(level, np.log1p(-min(limit, 0.95)))
    features = feature_rows(record_rows(panel, (unit, cycle)), critical, (unit, cycle))
    return features[:, np.array([name not in THERMAL for name in FEATURES])]


def foretell(teach: Rows, x: Array, level_rows: Index | None = None) -> Foretold:
    """Predict the remaining life of rows of units outside the training set.

    Each fold's rows are foretold by a model of the other folds, which gives the levels of the interval. The interval is
    that of one model of all folds: an average over models would be better than those that the levels were learned
    from, and hold too often. The distribution, and so the middle, is the average.

    Parameters
    ----------
    teach : Rows
        Whole lives.
    x : array, shape (n, p)
        Rows of other units.
    level_rows : array of int, optional
        Rows of `teach` that levels are learned from, such as those where a unit might be cut; all by default.
    """
    predicted = np.empty((teach.left.size, EDGES.size))
    forecasts = []
    for fold in np.unique(teach.fold):
        inside = teach.fold == fold
        model = _fitted(teach.of(~inside))
        predicted[inside] = event_by(hazards([model], teach.x[inside]))
        forecasts.append(event_by(hazards([model], x)))
    chosen = np.arange(teach.left.size) if level_rows is None else level_rows
    cut = _cuts(teach.unit[chosen], chosen)
    rows = predicted[cut], teach.left[cut], np.ones(cut.size, dtype=bool), teach.unit[cut]
    whole = event_by(hazards([_fitted(teach)], x))

    def interval(nominal: Levels) -> tuple[Array, Array]:
        levels = learn_levels(*rows, prior_lives=0.0, nominal=nominal)
        return quantile(whole, levels[0]), quantile(whole, levels[2])

    return Foretold(np.mean([*forecasts, whole], axis=0), *interval(NOMINAL), interval(WIDE))


def _fitted(teach: Rows) -> HistGradientBoostingClassifier:
    share = min(1.0, SAMPLES / (teach.left.size * SPANS))
    return fit_hazard(teach.x, teach.left, np.ones(teach.left.size, dtype=bool), 0, share=share)


def _cuts(unit: Index, chosen: Index) -> Index:
    """As many rows of each unit, at random: what is asked is asked somewhere in a life."""
    rng = np.random.default_rng(0)
    return np.concatenate([rng.choice(chosen[unit == u], CUTS) for u in np.unique(unit)])


def expected_left(by: Array, most: float) -> Array:
    """Mean of the remaining life, no more than `most`: the area under the survival curve up to there."""
    inside = EDGES[most >= EDGES]
    alive = 1.0 - by[:, : inside.size]
    return np.asarray((0.5 * (alive[:, 1:] + alive[:, :-1]) * np.diff(inside)).sum(axis=1))


def coverage(prediction: Foretold, left: Array) -> Array:
    """Whether each row's life lies in its interval; 1 and 0."""
    return ((prediction.low <= left) & (left <= prediction.high)).astype(float)
