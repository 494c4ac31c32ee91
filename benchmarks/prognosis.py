"""Alerts and remaining life by rolling origin: `python -m benchmarks.prognosis [--fleets N] [--write]`.

Claims: alerts come before the message and seldom without a cause; intervals of the remaining life cover 90 %; learning
helps; health parameters foretell better than raw sensors. A model of each month learns from what was on record when
the month began and is scored on that month, on fleets that the base did not learn from: they are flown by the
raw-signal simulator with seeds and designs of their own, through the whole chain; the base learned from tracks of the
episode simulator. Both share the shapes of wear. Beside the product its base alone (simulated lives, no
life of the fleet), physics alone (first passage, no learner) and a plain logistic hazard on loss and its trend, taught
by the same simulated lives and the fleet's record. Figures pool the fleets; ranges are 5 to 95 % over tails drawn anew.
`--write` puts the tables into docs/prognosis.md.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import polars as pl
from numpy.typing import ArrayLike, NDArray
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from benchmarks import by_reserve, price
from benchmarks.alerts import COMPONENTS, by_component, confusion, curves, figures_of, tally, together
from benchmarks.by_reserve import TypeRecord
from benchmarks.first_screen import (
    AUC_GOAL,
    BRIER_GOAL,
    COVERAGE_GOAL,
    ERROR_GOAL_FLIGHTS,
    SCORE_GOAL,
    first_screen,
)
from benchmarks.fleets import Frames, flown, reserve_class
from benchmarks.harness import DOCS, README, Texts, markdown, run
from benchmarks.held_out import SETS, Learner, extrapolated, lead_at_budget, rows_of
from benchmarks.held_out import together as pooled
from benchmarks.price import prices, with_signals
from hdt_core.prognosis.base import simulated_rows
from hdt_core.prognosis.feature_rows import INPUTS, PRIOR_RULES, Tracks, fleet_rows, tracks, tracks_as_of
from hdt_core.prognosis.fleet_record import FleetRecord, month_of, start_of
from hdt_core.prognosis.hazard import EDGES, SPANS, at_risk, event_by, passage_hazards, quantile
from hdt_core.prognosis.history import PASSAGE, PASSAGE_AHEAD
from hdt_core.prognosis.metrics import CAP, join_outcomes, score_prognoses
from hdt_core.prognosis.model import ComponentFit, Fold, Prognosis, predict_by_fold, prior_levels
from hdt_core.prognosis.recalibrate import NOMINAL
from hdt_core.prognosis.service import update_model
from hdt_core.records.keys import IN_ORDER
from hdt_core.simulate.design import FleetSettings
from pipelines.learned import shipped_base

PAGE = DOCS / "prognosis.md"
SCORED, TAUGHT = 9000, 6000
"""First seeds of the fleets that score, and of those that teach the contestants of the ablation."""
SIZE = FleetSettings(operators=2, tails=5, flights=400, cpl_share=0.0)
HORIZONS = ((0, 25), (25, 50), (50, 100), (100, 200), (200, 300))
RECALLS = (0.4, 0.8, 0.9)
ON_RECORD = ((0, 0), (1, 2), (3, 5), (6, 10), (11, 10**6))
"""Failures on a fleet's record when a month begins, from and to."""
GOALS = {
    "mae": f"{ERROR_GOAL_FLIGHTS:.0f}",
    "coverage": "-".join(f"{share:.2f}" for share in COVERAGE_GOAL),
    "score over a constant's": f"{SCORE_GOAL:.2f}",
    "Brier skill": f"{BRIER_GOAL:.2f}",
    "AUC": f"{AUC_GOAL:.2f}",
}


def life_figures(prognoses: pl.DataFrame) -> dict[str, float]:
    """Figures of judged prognoses: remaining life of lives whose end, or 300 flights more, is on record."""
    scores = score_prognoses(prognoses)
    ended = _ended(prognoses)
    truth, middle, low, high = (np.minimum(ended[c].to_numpy(), CAP) for c in _COLUMNS)
    inside = (low <= truth) & (truth <= high)
    beyond = (truth >= CAP) & (high >= CAP)
    failed = ended["failed"].to_numpy()
    return {
        "rows": float(ended.height),
        "mae": scores.get("mae_flights", np.nan),
        "bias before failures": _mean((middle - truth)[failed]),
        "coverage": scores.get("coverage", np.nan),
        "coverage, not both at 300": _mean(inside[~beyond]),
        "coverage, last 100": scores.get("coverage_last_100", np.nan),
        "width": _mean(high - low),
        "score over a constant's": 1.0 - scores.get("interval_skill", np.nan),
        "alpha-lambda, 20 %, last 100": scores.get("alpha_lambda_20", np.nan),
        "Brier skill": scores.get("brier_skill", np.nan),
        "AUC": scores.get("auc", np.nan),
    }


_COLUMNS = ("remaining", "rul_flights", "rul_low", "rul_high")


def _ended(prognoses: pl.DataFrame) -> pl.DataFrame:
    outlived = pl.col("failed") | (pl.col("remaining") >= CAP)
    return prognoses.filter(outlived & pl.col("rul_flights").is_not_null())


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else np.nan


def side_by_side(forecasts: dict[str, pl.DataFrame], draws: int) -> str:
    """A row a figure, a column a contestant; of the product the range over tails drawn anew."""
    columns = {name: life_figures(frame) for name, frame in forecasts.items()}
    rng = np.random.default_rng(0)
    tails = forecasts[CONTESTANTS[0]].partition_by("tail")
    resampled = (pl.concat([tails[k] for k in rng.integers(0, len(tails), len(tails))]) for _ in range(draws))
    drawn_figures = [life_figures(frame) for frame in resampled]
    lines = [["figure", "goal", *columns, f"{CONTESTANTS[0]}, 5-95 %"]]
    for name in next(iter(columns.values())):
        low, high = np.nanquantile([figures[name] for figures in drawn_figures], [0.05, 0.95])
        values = [f"{figures[name]:.3g}" for figures in columns.values()]
        lines.append([name, GOALS.get(name, ""), *values, f"{low:.3g} - {high:.3g}"])
    return markdown(lines)


def by_horizon(forecasts: dict[str, pl.DataFrame]) -> str:
    """Error and interval of the first by how much life was left before failures, and the others' errors."""
    own, *others = forecasts
    lines = [["flights left", "rows", "error", "bias", "coverage", "width", *(f"error, {name}" for name in others)]]
    for low, high in HORIZONS:
        near = pl.col("remaining").is_between(low, high, closed="right")
        parts = {name: _ended(frame).filter("failed", near) for name, frame in forecasts.items()}
        if parts[own].height:
            t, s, a, b = (parts[own][c].to_numpy() for c in _COLUMNS)
            cells = [np.abs(s - t).mean(), (s - t).mean(), ((a <= t) & (t <= b)).mean()]
            errors = [(parts[n]["rul_flights"] - parts[n]["remaining"]).abs().mean() for n in others]
            numbers = [*cells, (b - a).mean(), *errors]
            lines.append([f"{low}-{high}", str(len(t)), *(f"{c:.3g}" for c in numbers)])
    return markdown(lines)


def calibration(happened: ArrayLike, probability: ArrayLike, bins: int = 10) -> pl.DataFrame:
    """Reliability table: predicted, observed, n for each bin of the probability scale with rows."""
    frame = pl.DataFrame({"p": np.asarray(probability, dtype=float), "y": np.asarray(happened, dtype=float)})
    bin_ = (pl.col("p") * bins).floor().clip(0, bins - 1).alias("bin")
    bins_used = frame.group_by(bin_).agg(predicted=pl.col("p").mean(), observed=pl.col("y").mean(), n=pl.len())
    return bins_used.sort("bin").drop("bin")


def calibrated(prognoses: pl.DataFrame) -> str:
    """Reliability of `p_event_50` by tenth of its scale."""
    known_outcomes = prognoses.filter(pl.col("event_50").is_not_null() & pl.col("p_event_50").is_not_null())
    table = calibration(known_outcomes["event_50"].to_numpy(), known_outcomes["p_event_50"].to_numpy())
    rows = ([f"{a:.3f}", f"{b:.3f}", str(n)] for a, b, n in table.iter_rows())
    return markdown([["forecast", "share that came", "rows"], *rows])


def learning_curve(forecasts: dict[str, pl.DataFrame]) -> str:
    """The product and its base alone, by how many failures were on the fleet's record when the month began."""
    lines = [["failures on record", "contestant", "rows", "mae", "score over a constant's", "Brier skill", "AUC"]]
    for low, high in ON_RECORD:
        for name in (CONTESTANTS[0], "base alone"):
            part = forecasts[name].filter(pl.col("failures_on_record").is_between(low, high))
            figures = life_figures(part) if _ended(part).height else {}
            words = f"{low}" if low == high else f"{low}-{high}" if high < 10**6 else f"{low} and more"
            cells = (f"{figures.get(c, np.nan):.3g}" for c in lines[0][3:])
            lines.append([words, name, str(part.height), *cells])
    return markdown(lines)


def precision_recall(forecasts: dict[str, pl.DataFrame]) -> str:
    """Precision of "the message comes within 50 flights" at thresholds of `p_event_50` with these recalls."""
    rows = ([f"{r}", *(f"{_precision_at(frame, r):.3g}" for frame in forecasts.values())] for r in RECALLS)
    return markdown([["recall", *forecasts], *rows])


def _precision_at(prognoses: pl.DataFrame, recall: float) -> float:
    known_outcomes = prognoses.drop_nulls(["event_50", "p_event_50"]).sort("p_event_50", descending=True)
    hits = known_outcomes["event_50"].to_numpy().cumsum()
    first = int(np.searchsorted(hits, recall * hits[-1])) if hits.size and hits[-1] else -1
    return float(hits[first] / (first + 1)) if first >= 0 else np.nan


def ablation(taught: list[Frames], scored: list[Frames]) -> str:
    """The same learner on more and more of the twin."""
    learn = pooled([rows_of(f) for f in taught])
    test = pooled([rows_of(f) for f in scored])
    forecast = {name: Learner.fit(learn, name).predict(test, name) for name in (*SETS, "health parameters alone")}
    forecast["physics extrapolation, its error learned"] = extrapolated(learn, test)
    head = ["inputs", "mean absolute error", "interval skill", "coverage", "Brier skill", "AUC"]
    lines = [[*head, "lead, median", "early in 1,000"]]
    for name, frame in forecast.items():
        rows = frame.filter(pl.col("remaining") >= 1)
        scores = score_prognoses(rows)
        names = ("mae_flights", "interval_skill", "coverage", "brier_skill", "auc")
        median, _, early = lead_at_budget(rows)
        cells = [*(scores.get(n, np.nan) for n in names), median, early]
        lines.append([name, *(f"{v:.3g}" for v in cells)])
    return markdown(lines)


def constant(prognoses: pl.DataFrame) -> pl.DataFrame:
    """One forecast for every row, from the rows' own true lives: the best that a constant can do."""
    ended = np.minimum(_ended(prognoses)["remaining"].to_numpy(), CAP)
    low, middle, high = np.quantile(ended, [0.05, 0.5, 0.95])
    share = prognoses["event_50"].mean()
    return prognoses.with_columns(rul_low=low, rul_flights=middle, rul_high=high, p_event_50=pl.lit(share))


SEED, FLEETS = 7, 20
"""Of the simulated lives that teach the logistic hazard."""


def main(
    fleets: int = 12, draws: int = 200, flights: int = SIZE.flights, tails: int = SIZE.tails, taught_by: int = FLEETS
) -> Texts:
    """So many fleets that score, and as many that teach the ablation; bootstrap draws; flights of an aircraft, aircraft
    of an operator; fleets of simulated lives that teach the logistic hazard."""
    size_of_fleet = replace(SIZE, flights=flights, tails=tails)
    seeds = range(SCORED, SCORED + fleets)
    scored = list(flown(seeds, size_of_fleet))
    tallies = [tally(f) for f in scored]
    counted = together(tallies)
    forecasts_by = {c: [forecasts(f, c, taught_by) for f in scored] for c in ("HX", "CC")}
    forecasts_of = {c: _pooled(parts) for c, parts in forecasts_by.items()}
    for same in ("base alone", "physics alone"):  # a compressor's product is the first passage of its base
        del forecasts_of["CC"][same]
    of_exchangers = [forecast[CONTESTANTS[0]] for forecast in forecasts_by["HX"]]
    reserves = [reserve_class(seed) for seed in seeds]
    types = [TypeRecord(*parts) for parts in zip(reserves, tallies, of_exchangers, strict=True)]
    with_features = zip(of_exchangers, scored, reserves, strict=True)
    priced = prices([with_signals(rows, f["features"], reserve) for rows, f, reserve in with_features])
    figures = {c: {name: life_figures(frame) for name, frame in own.items()} for c, own in forecasts_of.items()}
    yield "first screen", first_screen({c: figures_of(counted, c) for c in COMPONENTS}, figures, priced)
    size = f"{fleets} types, a fleet each, {counted.flights:,} flights of two packs."
    yield "alerts", f"{size}\n\n{by_component(counted)}"
    yield "by reserve", by_reserve.table(types)
    yield "price", price.table(priced)
    yield "curves", curves(scored)
    yield "confusion", confusion(scored)
    for component, own in forecasts_of.items():
        yield f"life {component}", side_by_side(own, draws)
        yield f"horizon {component}", by_horizon(own)
        yield f"precision {component}", precision_recall(own)
        yield f"calibration {component}", calibrated(own[CONTESTANTS[0]])
    yield "learning HX", learning_curve(forecasts_of["HX"])
    taught = flown(range(TAUGHT, TAUGHT + fleets), size_of_fleet)
    yield "ablation", ablation(list(taught), scored)


def _pooled(parts: list[dict[str, pl.DataFrame]]) -> dict[str, pl.DataFrame]:
    together_by = {name: pl.concat([part[name] for part in parts], how="diagonal_relaxed") for name in parts[0]}
    return together_by | {"constant": constant(together_by[CONTESTANTS[0]])}


Array = NDArray[np.float64]
CONTESTANTS = ("product", "base alone", "physics alone", "logistic hazard")
TREND = ("level", "slope_30", "slope_100")


def forecasts(fleet: Frames, component: str, taught_by: int) -> dict[str, pl.DataFrame]:
    """Judged prognoses of a component by contestant, with the failures on record when each flight's month began."""
    record = FleetRecord(fleet["features"], fleet["messages"], fleet["maintenance"])
    lives = record.lives()
    base = shipped_base()
    product = update_model(base, None, record).prognoses
    alone = {c: ComponentFit(rule, levels=prior_levels(base, c)) for c, rule in PRIOR_RULES.items()}
    by_base = predict_prognosis(Prognosis(base.hazard, base.base_levels, alone, "base"), record.features, lives)
    track = tracks(record.features, lives, component)
    rows = fleet_rows(track, PRIOR_RULES[component]).features
    by_contestant = {"product": product, "base alone": by_base, "physics alone": _physics(track, rows, component)}
    if component == "HX":
        by_contestant["logistic hazard"] = _logistic(record, track, rows, component, taught_by)
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


def _logistic(record: FleetRecord, track: Tracks, rows: Array, component: str, taught_by: int) -> pl.DataFrame:
    """A logistic hazard of each month, from simulated lives and the fleet's lives before it."""
    trend = _trend(rows)
    month_at = month_of(track.keys["departed_at"])
    by = np.full((len(rows), EDGES.size), np.nan)
    simulated = _simulated(taught_by)
    for month in record.months():
        before = record.as_of(start_of(month))
        own = fleet_rows(tracks_as_of(track, start_of(month), before.lives(), component), PRIOR_RULES[component])
        use = (own.remaining >= 1) & ~np.isnan(own.features[:, INPUTS.index("level")])
        this_month = (month_at == month).to_numpy()
        on_record = _trend(own.features[use]), own.remaining[use], own.failed[use]
        by[this_month] = _fitted(simulated, on_record)(trend[this_month])
    return _prognoses(track, by, component)


def _trend(rows: Array) -> Array:
    return np.nan_to_num(np.stack([rows[:, INPUTS.index(name)] for name in TREND], axis=1))


Lives = tuple[Array, Array, NDArray[np.bool_]]
"""Loss and its trend (rows, 3), flights left (rows,), whether the life ended in a failure (rows,)."""


@cache
def _simulated(fleets: int) -> Lives:
    lives = simulated_rows(SEED, fleets)
    return _trend(lives.features), lives.remaining, lives.failed


def _fitted(simulated: Lives, on_record: Lives):
    """P(event within EDGES flights) as a function of loss and trend."""
    trend, left, failed = (np.concatenate(pair) for pair in zip(simulated, on_record, strict=True))
    row, span, hit, exposure = at_risk(left, failed)
    model = make_pipeline(StandardScaler(), LogisticRegression(max_iter=200))
    model.fit(np.hstack([trend[row], np.eye(SPANS)[span]]), hit, logisticregression__sample_weight=exposure)

    def by(at_risk_rows: Array) -> Array:
        row = np.repeat(np.arange(len(at_risk_rows)), SPANS)
        span = np.tile(np.arange(SPANS), len(at_risk_rows))
        hazard = model.predict_proba(np.hstack([at_risk_rows[row], np.eye(SPANS)[span]]))[:, 1]
        return event_by(hazard.reshape(-1, SPANS))

    return by


def _prognoses(track: Tracks, by: Array, component: str) -> pl.DataFrame:
    """A distribution as rows of `prognoses`; null where the health is not known."""
    low, middle, high = (np.where(np.isnan(by[:, -1]), np.nan, quantile(np.nan_to_num(by), p)) for p in NOMINAL)
    numbers = {"rul_low": low, "rul_flights": middle, "rul_high": high, "p_event_50": by[:, EDGES.tolist().index(50.0)]}
    columns = {name: pl.Series(np.where(track.at[:, 1] >= 0, v, np.nan)).fill_nan(None) for name, v in numbers.items()}
    return track.keys.with_columns(component=pl.lit(component), **columns)


if __name__ == "__main__":
    run(main, page=PAGE, elsewhere={"first screen": README})
