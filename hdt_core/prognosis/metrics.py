"""How good a prognosis was: error, intervals, probabilities and horizons, each a number a reader can check by hand.

References
----------
.. [1] A. Saxena et al., Metrics for offline evaluation of prognostic performance, IJPHM 1 (1), 2010 (alpha-lambda,
   prognostic horizon).
.. [2] T. Gneiting, A. E. Raftery, Strictly proper scoring rules, JASA 102, 2007 (interval score, Brier score).
"""

from collections.abc import Callable

import numpy as np
import polars as pl
from numpy.typing import ArrayLike, NDArray
from scipy.stats import rankdata

from hdt_core.prognosis.unit_lives import flight_rows, with_lives

Array = NDArray[np.float64]

CAP = 300.0


def interval_score(truth: ArrayLike, low: ArrayLike, high: ArrayLike, alpha: float = 0.1) -> Array:
    """Width plus 2/alpha times what falls outside, per row; smaller is better. Same unit as the truth.

    Examples
    --------
    >>> interval_score([5.0, 12.0], [0.0, 0.0], [10.0, 10.0]).tolist()
    [10.0, 50.0]
    """
    t, a, b = (np.asarray(v, dtype=float) for v in (truth, low, high))
    return np.asarray((b - a) + 2.0 / alpha * (np.maximum(a - t, 0.0) + np.maximum(t - b, 0.0)))


def constant_interval_score(truth: ArrayLike, alpha: float = 0.1) -> float:
    """Mean interval score of one interval for every row, from the true lives' own quantiles."""
    t = np.asarray(truth, dtype=float)
    low, high = np.quantile(t, [alpha / 2.0, 1.0 - alpha / 2.0])
    return float(interval_score(t, np.full(t.size, low), np.full(t.size, high), alpha).mean())


def brier_skill(happened: ArrayLike, probability: ArrayLike) -> float:
    """1 - Brier score over that of the base rate; 0 says nothing, 1 is perfect."""
    y, p = np.asarray(happened, dtype=float), np.asarray(probability, dtype=float)
    return float(1.0 - np.mean((p - y) ** 2) / (y.mean() * (1.0 - y.mean())))


def auc(happened: ArrayLike, probability: ArrayLike) -> float:
    """Chance that a row with the event was given more than one without, ties counted half."""
    y, p = np.asarray(happened, dtype=bool), np.asarray(probability, dtype=float)
    hits = int(y.sum())
    return float((rankdata(p)[y].sum() - hits * (hits + 1) / 2.0) / (hits * (y.size - hits)))


def alpha_lambda(truth: ArrayLike, said: ArrayLike, alpha: float = 0.2) -> float:
    """Share of rows within +-alpha of the true remaining life [1]."""
    t, s = np.asarray(truth, dtype=float), np.asarray(said, dtype=float)
    return float(np.mean(np.abs(s - t) <= alpha * t))


def prognostic_horizon(truth: ArrayLike, said: ArrayLike, band: float) -> float:
    """Remaining life from which one life's prognosis stays within +-`band` to the end [1]. [flight]"""
    t, s = np.asarray(truth, dtype=float), np.asarray(said, dtype=float)
    order = np.argsort(t)
    outside = np.abs(s - t)[order] > band
    return float(t[order][-1] if not outside.any() else 0.0 if outside[0] else t[order][outside.argmax() - 1])


def calibration(happened: ArrayLike, probability: ArrayLike, bins: int = 10) -> pl.DataFrame:
    """What was said against what came: said, came, n for each tenth of the probability scale that was used."""
    frame = pl.DataFrame({"p": np.asarray(probability, dtype=float), "y": np.asarray(happened, dtype=float)})
    bin_ = (pl.col("p") * bins).floor().clip(0, bins - 1).alias("bin")
    return (
        frame.group_by(bin_).agg(said=pl.col("p").mean(), came=pl.col("y").mean(), n=pl.len()).sort("bin").drop("bin")
    )


def bootstrap(
    frame: pl.DataFrame, metric: Callable[[pl.DataFrame], float], by: str = "tail", draws: int = 200, seed: int = 0
) -> tuple[float, float]:
    """5 and 95 % points of a metric when whole groups are drawn again: flights of a tail aren't independent."""
    rng = np.random.default_rng(seed)
    parts = frame.partition_by(by)
    values = [metric(pl.concat([parts[i] for i in rng.integers(0, len(parts), len(parts))])) for _ in range(draws)]
    found = np.asarray(values)[np.isfinite(values)]
    low, high = np.quantile(found, [0.05, 0.95])
    return float(low), float(high)


def judge(prognoses: pl.DataFrame, features: pl.DataFrame, lives: pl.DataFrame, component: str = "HX") -> pl.DataFrame:
    """Prognoses with what became of them.

    Returns
    -------
    DataFrame
        The prognoses' columns and `left` (flights until the message or until the life was cut), `failed`, `life`, and
        `event_50` (null where fewer than 50 flights were seen after and none failed).
    """
    flown = with_lives(flight_rows(features), lives, component)
    truth = flown.select("tail", "flight_id", "pack", "left", "failed", life="life_id")
    hit = pl.col("failed") & (pl.col("left") <= 50)
    return (
        prognoses.filter(pl.col("component") == component)
        .join(truth, on=["tail", "flight_id", "pack"], validate="m:1")
        .filter(pl.col("left") >= 1)
        .with_columns(event_50=pl.when(hit).then(1.0).when(pl.col("left") > 50).then(0.0))
    )


def score_prognoses(judged: pl.DataFrame) -> dict[str, float]:
    """Figures over judged prognoses; remaining life capped at 300 flights.

    Of every flight of which it is known: the message came, or the unit outlived 300 more flights. Lives that ended in
    the message alone would reward whoever always foretells one. A figure that can't be computed is left out.
    """
    outlived = pl.col("failed") | (pl.col("left") >= CAP)
    ended = judged.filter(outlived & pl.col("rul_flights").is_not_null())
    asked = judged.filter(pl.col("event_50").is_not_null() & pl.col("p_event_50").is_not_null())
    scores: dict[str, float] = {"failures": float(ended.filter("failed")["life"].n_unique())}
    if ended.height:
        truth, said, low, high = (
            np.minimum(ended[c].to_numpy(), CAP) for c in ("left", "rul_flights", "rul_low", "rul_high")
        )
        scores["mae_flights"] = float(np.abs(said - truth).mean())
        scores["interval_score_flights"] = float(interval_score(truth, low, high).mean())
        scores["coverage"] = float(((low <= truth) & (truth <= high)).mean())
        constant = constant_interval_score(truth)
        if constant > 0.0:  # where all units outlived, one interval says it all
            scores["interval_skill"] = 1.0 - scores["interval_score_flights"] / constant
        near = truth <= 100
        if near.any():
            scores["coverage_last_100"] = float(((low <= truth) & (truth <= high))[near].mean())
            scores["alpha_lambda_20"] = alpha_lambda(truth[near], said[near])
    if 0 < asked["event_50"].sum() < asked.height:
        y, p = asked["event_50"].to_numpy(), asked["p_event_50"].to_numpy()
        scores |= {"brier": float(np.mean((p - y) ** 2)), "brier_skill": brier_skill(y, p), "auc": auc(y, p)}
    return scores
