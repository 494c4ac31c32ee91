"""Score prognoses: error, intervals, and probabilities.

References
----------
.. [1] A. Saxena et al., Metrics for offline evaluation of prognostic performance, IJPHM 1 (1), 2010 (alpha-lambda).
.. [2] T. Gneiting, A. E. Raftery, Strictly proper scoring rules, JASA 102, 2007 (interval score, Brier score).
"""

import numpy as np
import polars as pl
from numpy.typing import ArrayLike

from hdt_core.prognosis.unit_lives import flight_rows, with_lives
from hdt_core.records.keys import LEG
from hdt_core.robust import Array

CAP = 300.0


def interval_score(truth: ArrayLike, low: ArrayLike, high: ArrayLike, alpha: float = 0.1) -> Array:
    """Compute width plus 2/alpha times the miss, per row; smaller is better. Same unit as the truth.

    Examples
    --------
    >>> interval_score([5.0, 12.0], [0.0, 0.0], [10.0, 10.0]).tolist()
    [10.0, 50.0]
    """
    t, a, b = (np.asarray(v, dtype=float) for v in (truth, low, high))
    return np.asarray((b - a) + 2.0 / alpha * (np.maximum(a - t, 0.0) + np.maximum(t - b, 0.0)))


def constant_interval_score(truth: ArrayLike, alpha: float = 0.1) -> float:
    """Compute the mean interval score of one interval for every row, from the true lives' own quantiles."""
    t = np.asarray(truth, dtype=float)
    low, high = np.quantile(t, [alpha / 2.0, 1.0 - alpha / 2.0])
    return float(interval_score(t, np.full(t.size, low), np.full(t.size, high), alpha).mean())


def brier_skill(is_event: ArrayLike, probability: ArrayLike) -> float:
    """Compute 1 - Brier score over that of the base rate; 0 is no skill, 1 is perfect."""
    y = np.asarray(is_event, dtype=float)
    p = np.asarray(probability, dtype=float)
    return float(1.0 - np.mean((p - y) ** 2) / (y.mean() * (1.0 - y.mean())))


def auc(is_event: ArrayLike, probability: ArrayLike) -> float:
    """Compute the probability that a row with the event ranks above one without, ties counted half."""
    from scipy.stats import rankdata  # noqa: PLC0415 (loads for half a second, and few nights score)

    y = np.asarray(is_event, dtype=bool)
    p = np.asarray(probability, dtype=float)
    hits = int(y.sum())
    return float((rankdata(p)[y].sum() - hits * (hits + 1) / 2.0) / (hits * (y.size - hits)))


def alpha_lambda(truth: ArrayLike, estimate: ArrayLike, alpha: float = 0.2) -> float:
    """Compute the share of rows within +-alpha of the true remaining life [1]."""
    t = np.asarray(truth, dtype=float)
    s = np.asarray(estimate, dtype=float)
    return float(np.mean(np.abs(s - t) <= alpha * t))


def join_outcomes(
    prognoses: pl.DataFrame, features: pl.DataFrame, lives: pl.DataFrame, component: str = "HX"
) -> pl.DataFrame:
    """Join prognoses with the outcomes of their lives.

    Returns
    -------
    DataFrame
        The prognoses' columns and `remaining` (flights until the message or the end of the record), `failed`, `life`,
        and `event_50` (null for a life censored within 50 flights).
    """
    flights = with_lives(flight_rows(features), lives, component)
    truth = flights.select(*LEG, "remaining", "failed", life="life_id")
    is_hit = pl.col("failed") & (pl.col("remaining") <= 50)
    return (
        prognoses.filter(pl.col("component") == component)
        .join(truth, on=LEG, validate="m:1")
        .filter(pl.col("remaining") >= 1)
        .with_columns(event_50=pl.when(is_hit).then(1.0).when(pl.col("remaining") > 50).then(0.0))
    )


def score_prognoses(prognoses: pl.DataFrame) -> dict[str, float]:
    """Score prognoses with outcomes; remaining life is capped at 300 flights.

    A flight counts where the message came or the unit outlived 300 more flights; lives that ended in the message alone
    would reward predicting one always. Scores that can't be computed are omitted.
    """
    is_known = pl.col("failed") | (pl.col("remaining") >= CAP)
    outcomes = prognoses.filter(is_known & pl.col("rul_flights").is_not_null())
    events = prognoses.filter(pl.col("event_50").is_not_null() & pl.col("p_event_50").is_not_null())
    scores: dict[str, float] = {"failures": float(outcomes.filter("failed")["life"].n_unique())}
    if outcomes.height:
        truth, median, low, high = (
            np.minimum(outcomes[c].to_numpy(), CAP) for c in ("remaining", "rul_flights", "rul_low", "rul_high")
        )
        scores["mae_flights"] = float(np.abs(median - truth).mean())
        scores["interval_score_flights"] = float(interval_score(truth, low, high).mean())
        scores["coverage"] = float(((low <= truth) & (truth <= high)).mean())
        constant = constant_interval_score(truth)
        if constant > 0.0:  # 0 where all units outlived the cap
            scores["interval_skill"] = 1.0 - scores["interval_score_flights"] / constant
        near = truth <= 100
        if near.any():
            scores["coverage_last_100"] = float(((low <= truth) & (truth <= high))[near].mean())
            scores["alpha_lambda_20"] = alpha_lambda(truth[near], median[near])
    if 0 < events["event_50"].sum() < events.height:
        y = events["event_50"].to_numpy()
        p = events["p_event_50"].to_numpy()
        scores |= {"brier": float(np.mean((p - y) ** 2)), "brier_skill": brier_skill(y, p), "auc": auc(y, p)}
    return scores
