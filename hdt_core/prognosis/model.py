"""Prognosis: how many flights are left, how sure, and how likely a message is within fifty.

A gradient-boosted hazard learned from simulated lives is the prior; a fleet's own lives move the limit, the hazard and
the interval. Remaining life is told for the case that the message comes within the horizon (300 flights): median and
90 % interval of the flights left, given that. How likely it is to come at all is `p_event_50`, without any condition.
"""

import hashlib
import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingClassifier

from hdt_core.prognosis.hazard import EDGES, event_by, fit_hazard, hazards, quantile, within_horizon
from hdt_core.prognosis.history import FEATURES
from hdt_core.prognosis.limits import PRIORS, Limit, learn_limit
from hdt_core.prognosis.recalibrate import Correction, learn_correction, learn_levels, simulated_levels
from hdt_core.prognosis.rows import Tracks, fleet_rows, message_levels, simulated_rows, tracks
from hdt_core.records.unit_index import PACK

Array = NDArray[np.float64]

HORIZON = float(EDGES[-1])
_LEVEL = FEATURES.index("level")
MEMBERS = 3
"""Models in the base."""
LEARN_EVERY, LEARN_ROWS = 4, 15_000
"""Of a life's flights one in so many corrects the base: neighbours say the same. Of a large fleet fewer still: what is
learned are a few numbers, and so many rows tell them."""
FOLDS = 5
HELD = "out_of_fold"
IN_ORDER = ("component", *PACK, "departed_at")
_AT_50 = int(np.searchsorted(EDGES, 50.0))


@dataclass(frozen=True, slots=True)
class Fit:
    """What one component's lives taught: the limit, the hazard's correction, the interval's quantile levels."""

    limit: Limit
    correction: Correction = field(default_factory=Correction)
    levels: tuple[float, float] = (0.05, 0.95)
    failures: int = 0
    lives: int = 0


Fits = dict[str, Fit]
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
        Quantile levels of the 90 % interval on simulated lives held out.
    fits : dict of str to Fit
        By component.
    version : str
        Digest of all the above.
    folds : tuple of Fold
        What judges each of the fleet's own tails; empty where the model was not learned from a fleet.
    """

    hazard: tuple[HistGradientBoostingClassifier, ...]
    base_levels: tuple[float, float]
    fits: Fits = field(default_factory=dict)
    version: str = ""
    folds: tuple[Fold, ...] = ()


def fit_prognosis(
    features: pl.DataFrame, lives: pl.DataFrame, seed: int = 0, base: Prognosis | None = None
) -> Prognosis:
    """Model for live use, from simulated lives and all of the fleet's own.

    Parameters
    ----------
    features : DataFrame
        operator, tail, flight_id, pack, departed_at, hx_fouling, hx_fouling_sd and, where there are,
        cc_efficiency_loss, cc_efficiency_loss_sd, cc_diameter_loss. May be empty.
    lives : DataFrame
        From `lives.episodes`. May hold no failure.
    seed : int
        Same seed, same model.
    base : Prognosis, optional
        What `fit_base` gave, where it is kept; it depends on no fleet.
    """
    return fit_tracks(base or fit_base(seed), {c: tracks(features, lives, c) for c in PRIORS})


def fit_tracks(base: Prognosis, lived: dict[str, Tracks]) -> Prognosis:
    """`base` with what all tracks of a fleet teach."""
    return named(base, {c: _learn(base, track, c) for c, track in lived.items()})


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
    parts = [_say(model, tracks(features, lives, c), model.fits[c], c, split) for c in PRIORS]
    return pl.concat(parts).sort(IN_ORDER)


def out_of_fold(
    features: pl.DataFrame,
    lives: pl.DataFrame,
    seed: int = 0,
    base: Prognosis | None = None,
    by: str = "tail",
) -> pl.DataFrame:
    """Prognoses of each tail from a model that never saw that tail's own lives; the base saw simulated ones only.

    With `by="operator"` no life of the tail's whole operator was seen: what a new operator may expect.
    """
    base = base or fit_base(seed)
    lived = {c: tracks(features, lives, c) for c in PRIORS}
    return say_by_fold(base, learn_folds(base, lived, features[by].unique().to_list(), by), lived, by=by)


def learn_folds(base: Prognosis, lived: dict[str, Tracks], groups: list[str], by: str = "tail") -> tuple[Fold, ...]:
    """What all but a fold's groups teach, for each fold; groups of which nothing is known yet have their fold too."""
    folds = []
    for k in range(min(FOLDS, len(groups))):
        held = tuple(sorted(groups)[k::FOLDS])
        others = {c: ~np.isin(track.keys[by].to_numpy().astype(str), held) for c, track in lived.items()}
        folds.append(Fold(held, {c: _learn(base, lived[c], c, others[c]) for c in lived}))
    return tuple(folds)


def say_by_fold(
    base: Prognosis,
    folds: tuple[Fold, ...],
    lived: dict[str, Tracks],
    asked: dict[str, NDArray[np.bool_]] | None = None,
    by: str = "tail",
) -> pl.DataFrame:
    """Prognoses of all flights, or of those asked about, each group by the fold that never saw it."""
    parts = [
        _say(base, _only(track, np.zeros(len(track.at), bool)), Fit(PRIORS[c]), c, HELD) for c, track in lived.items()
    ]
    for component, track in lived.items():
        wanted = np.ones(len(track.at), bool) if asked is None else asked[component]
        own = track.keys[by].to_numpy().astype(str)
        for fold in folds:
            rows, model = wanted & np.isin(own, fold.held), named(base, {component: fold.fits[component]})
            parts.append(_say(model, _only(track, rows), fold.fits[component], component, HELD))
    return pl.concat(parts).sort(IN_ORDER)


def fit_base(seed: int = 0, members: int = MEMBERS, fleets: int = 50) -> Prognosis:
    """Base learned from simulated lives alone: the same for every fleet, so it need be fitted once.

    Parameters
    ----------
    seed : int
        Same seed, same base.
    members, fleets : int
        Models, and simulated fleets that each of them learns from.
    """
    learned = []
    for member in range(members):
        rows = simulated_rows(members * seed + member, fleets)
        learned.append(fit_hazard(rows.features, rows.left, rows.failed, seed))
    check = simulated_rows(members * seed + members, fleets=20)
    check = check.take(check.failed)
    return Prognosis(tuple(learned), simulated_levels(hazards(learned, check.features), check.left, check.life))


def _learn(base: Prognosis, track: Tracks, component: str, use: NDArray[np.bool_] | None = None) -> Fit:
    """Limit, then correction, then interval levels, from the rows in `use`."""
    use = np.ones(track.left.size, bool) if use is None else use
    levels, tails = message_levels(track)
    seen = np.unique(track.keys["tail"].to_numpy().astype(str)[use])
    levels = levels[np.isin(tails, seen)]
    limit = learn_limit(levels, PRIORS[component])
    every = max(LEARN_EVERY, -(-int(use.sum()) // LEARN_ROWS))
    rows = fleet_rows(track, limit).take(use & (track.at[:, 1] % every == 0))
    rows = rows.take((rows.left >= 1) & np.isfinite(rows.features[:, _LEVEL]))
    failures = int(np.unique(rows.life[rows.failed]).size)
    if not failures:
        return Fit(limit, levels=base.base_levels, lives=int(np.unique(rows.life).size))
    raw = hazards(base.hazard, rows.features)
    correction = learn_correction(raw, rows.features[:, _LEVEL], rows.left, rows.failed, rows.life)
    by = event_by(correction(raw, rows.features[:, _LEVEL]))[rows.failed]
    interval = learn_levels(by, rows.left[rows.failed], rows.life[rows.failed], base.base_levels)
    return Fit(limit, correction, interval, failures, int(np.unique(rows.life).size))


def _only(track: Tracks, rows: NDArray[np.bool_]) -> Tracks:
    """The tracks of the lives that some flights belong to, asked about those flights."""
    lives, life = np.unique(track.at[rows, 0], return_inverse=True)
    at = np.column_stack([life, track.at[rows, 1]])
    cut = {name: getattr(track, name)[lives] for name in ("value", "sd", "age", "door")}
    return Tracks(**cut, at=at, keys=track.keys.filter(rows), left=track.left[rows], failed=track.failed[rows])


def _say(model: Prognosis, track: Tracks, fit: Fit, component: str, split: str) -> pl.DataFrame:
    rows = fleet_rows(track, fit.limit)
    by = event_by(fit.correction(hazards(model.hazard, rows.features), rows.features[:, _LEVEL]))
    given = within_horizon(by)
    known = np.isfinite(rows.features[:, _LEVEL])
    numbers = {
        "rul_flights": quantile(given, 0.5),
        "rul_low": np.minimum(quantile(given, fit.levels[0]), quantile(given, 0.5)),
        "rul_high": np.maximum(quantile(given, fit.levels[1]), quantile(given, 0.5)),
        "p_event_50": by[:, _AT_50],
    }
    columns = [pl.Series(name, np.where(known, v, np.nan)).fill_nan(None) for name, v in numbers.items()]
    return track.keys.select(
        "operator", "tail", "flight_id", "pack", pl.lit(component).alias("component"), "departed_at", *columns,
        pl.lit(model.version).alias("model_version"), pl.lit(split).alias("split"),
    )  # fmt: skip


def named(base: Prognosis, fits: Fits | None = None) -> Prognosis:
    """`base` with these fits, and the digest of both for a version."""
    fits = fits or {}
    told: dict[str, Any] = {c: [f.limit.mean, f.limit.sd, f.correction.weights, f.levels] for c, f in fits.items()}
    told["base"] = [
        base.base_levels,
        [float(np.sum(m.train_score_)) if len(m.train_score_) else m.n_iter_ for m in base.hazard],
    ]
    digest = hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:12]
    return Prognosis(base.hazard, base.base_levels, fits, digest)
