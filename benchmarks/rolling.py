"""Forecasts of remaining life by rolling origin: each month by what was on record when it began.

Beside the product its base alone (simulated lives, no life of the fleet), physics alone (first passage, no learner) and
a plain logistic hazard on loss and its trend, taught by the same simulated lives and the fleet's record.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import polars as pl
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from benchmarks.fleets import Frames
from hdt_core.prognosis.base import simulated_rows
from hdt_core.prognosis.feature_rows import INPUTS, PRIOR_RULES, Tracks, fleet_rows, tracks, tracks_as_of
from hdt_core.prognosis.fleet_record import FleetRecord, month_of, start_of
from hdt_core.prognosis.hazard import EDGES, SPANS, at_risk, event_by, passage_hazards, quantile
from hdt_core.prognosis.history import PASSAGE, PASSAGE_AHEAD
from hdt_core.prognosis.metrics import join_outcomes
from hdt_core.prognosis.model import ComponentFit, Fold, Prognosis, predict_by_fold, prior_levels
from hdt_core.prognosis.recalibrate import NOMINAL
from hdt_core.prognosis.service import update_model
from hdt_core.records.keys import IN_ORDER
from pipelines.learned import shipped_base

Array = NDArray[np.float64]
CONTESTANTS = ("product", "base alone", "physics alone", "logistic hazard")
TREND = ("level", "slope_30", "slope_100")
SEED, FLEETS = 7, 20
"""Of the simulated lives that teach the logistic hazard."""


def forecasts(fleet: Frames, component: str) -> dict[str, pl.DataFrame]:
    """Judged prognoses of a component by contestant, with the failures on record when each flight's month began."""
    record = FleetRecord(fleet["features"], fleet["messages"], fleet["maintenance"])
    lives, base = record.lives(), shipped_base()
    product = update_model(base, None, record).prognoses
    alone = {c: ComponentFit(rule, levels=prior_levels(base, c)) for c, rule in PRIOR_RULES.items()}
    by_base = predict_prognosis(Prognosis(base.hazard, base.base_levels, alone, "base"), record.features, lives)
    track = tracks(record.features, lives, component)
    rows = fleet_rows(track, PRIOR_RULES[component]).features
    by_contestant = {"product": product, "base alone": by_base, "physics alone": _physics(track, rows, component)}
    if component == "HX":
        by_contestant["logistic hazard"] = _logistic(record, track, rows, component)
    counted = [(month, _failures(record, month, component)) for month in record.months()]
    schema = {"month": pl.Date, "failures_on_record": pl.Int64}
    on_record = pl.DataFrame(counted, schema=schema, orient="row")
    return {
        name: join_outcomes(prognoses, record.features, lives, component)
        .with_columns(month=pl.col("departed_at").dt.month_start().dt.date())
        .join(on_record, on="month", validate="m:1")
        for name, prognoses in by_contestant.items()
    }


def predict_prognosis(model: Prognosis, features: pl.DataFrame, lives: pl.DataFrame) -> pl.DataFrame:
    """Prognoses of every flight by the fits to the whole fleet."""
    whole = replace(model, folds=(Fold(tuple(features["tail"].unique()), model.fits),))
    by_component = {c: tracks(features, lives, c) for c in PRIOR_RULES}
    parts = (predict_by_fold(whole, c, track, np.ones(len(track.at), bool)) for c, track in by_component.items())
    return pl.concat(parts).sort("component", *IN_ORDER)


def _failures(record: FleetRecord, month, component: str) -> int:
    return record.as_of(start_of(month)).lives().filter(pl.col("failed"), component=component).height


def _physics(track: Tracks, rows: Array, component: str) -> pl.DataFrame:
    """The first passage as it stands: its distribution at four horizons, linear between them."""
    by = np.stack([rows[:, INPUTS.index(name)] for name in PASSAGE[:-1]], axis=1)
    return _prognoses(track, event_by(passage_hazards(by, PASSAGE_AHEAD)), component)


def _logistic(record: FleetRecord, track: Tracks, rows: Array, component: str) -> pl.DataFrame:
    """A logistic hazard of each month, from simulated lives and the fleet's lives before it."""
    trend, month_at = _trend(rows), month_of(track.keys["departed_at"])
    by = np.full((len(rows), EDGES.size), np.nan)
    for month in record.months():
        before = record.as_of(start_of(month))
        own = fleet_rows(tracks_as_of(track, start_of(month), before.lives(), component), PRIOR_RULES[component])
        use = (own.remaining >= 1) & ~np.isnan(own.features[:, INPUTS.index("level")])
        this_month = (month_at == month).to_numpy()
        by[this_month] = _fitted(_trend(own.features[use]), own.remaining[use], own.failed[use])(trend[this_month])
    return _prognoses(track, by, component)


def _trend(rows: Array) -> Array:
    return np.nan_to_num(np.stack([rows[:, INPUTS.index(name)] for name in TREND], axis=1))


@cache
def _simulated() -> tuple[Array, Array, NDArray[np.bool_]]:
    lives = simulated_rows(SEED, FLEETS)
    return _trend(lives.features), lives.remaining, lives.failed


def _fitted(trend: Array, left: Array, failed: NDArray[np.bool_]):
    """P(event within EDGES flights) as a function of loss and trend."""
    simulated = _simulated()
    trend, left, failed = (np.concatenate(pair) for pair in zip(simulated, (trend, left, failed), strict=True))
    row, span, hit, exposure = at_risk(left, failed)
    model = make_pipeline(StandardScaler(), LogisticRegression(max_iter=200))
    model.fit(np.hstack([trend[row], np.eye(SPANS)[span]]), hit, logisticregression__sample_weight=exposure)

    def by(at_risk_rows: Array) -> Array:
        row, span = np.repeat(np.arange(len(at_risk_rows)), SPANS), np.tile(np.arange(SPANS), len(at_risk_rows))
        hazard = model.predict_proba(np.hstack([at_risk_rows[row], np.eye(SPANS)[span]]))[:, 1]
        return event_by(hazard.reshape(-1, SPANS))

    return by


def _prognoses(track: Tracks, by: Array, component: str) -> pl.DataFrame:
    """A distribution as rows of `prognoses`; null where the health is not known."""
    low, middle, high = (np.where(np.isnan(by[:, -1]), np.nan, quantile(np.nan_to_num(by), p)) for p in NOMINAL)
    numbers = {"rul_low": low, "rul_flights": middle, "rul_high": high, "p_event_50": by[:, EDGES.tolist().index(50.0)]}
    columns = {name: pl.Series(np.where(track.at[:, 1] >= 0, v, np.nan)).fill_nan(None) for name, v in numbers.items()}
    return track.keys.with_columns(component=pl.lit(component), **columns)
