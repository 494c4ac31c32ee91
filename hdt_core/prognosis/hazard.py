"""Discrete-time hazard by gradient boosting: the probability of the event in each of the coming spans of flights.

A row at risk in a span is one sample of a classifier whose inputs are the unit's features and the span. A censored
life leaves the risk set when it was cut, so nothing is assumed about its end.
"""

from collections.abc import Sequence
from functools import cache, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import expit
from threadpoolctl import ThreadpoolController

from hdt_core.robust import Array

if TYPE_CHECKING:  # scikit-learn takes a second to load
    from sklearn.ensemble import HistGradientBoostingClassifier

EDGES = np.array([0, 5, 10, 15, 20, 30, 40, 50, 65, 80, 100, 125, 150, 175, 200, 250, 300], dtype=float)
SPANS = EDGES.size - 1
AHEAD = (25, 50, 100, 200, 300)
"""Flights for which the probability of a message is reported."""
_LEAST_ALIVE = 1e-9
ROWS_AT_ONCE = 8_192
"""Rows predicted at once, so that memory does not grow with the fleet."""


def at_risk(remaining: Array, failed: Array) -> tuple[Array, Array, Array, Array]:
    """List every (row, span) in which a row was still at risk, whether the event fell in it, and for how much of it.

    Parameters
    ----------
    remaining : array, shape (n,)
        Flights until the event, or until the life was cut short. [flight], >= 0
    failed : array of bool, shape (n,)
        Whether `remaining` ended in the event.

    Returns
    -------
    row, span, hit, exposure : ndarray
        A span in which a life was cut short counts for the share of it that was survived (the actuarial rule); every
        other one counts in full.
    """
    row = np.repeat(np.arange(remaining.size), SPANS)
    span = np.tile(np.arange(SPANS), remaining.size)
    starts = EDGES[span]
    ends = EDGES[span + 1]
    is_event = failed[row] & (remaining[row] > starts) & (remaining[row] <= ends)
    exposure = np.where(is_event, 1.0, np.clip((remaining[row] - starts) / (ends - starts), 0.0, 1.0))
    is_exposed = exposure > 0.0
    return row[is_exposed], span[is_exposed], is_event[is_exposed], exposure[is_exposed]


def with_span(features: Array, span: Array) -> Array:
    """Append the end of the span to the features."""
    return np.concatenate([features, EDGES[span + 1][:, None]], axis=1)


def fit_hazard(
    features: Array,
    remaining: Array,
    failed: Array,
    seed: int,
    rises: Sequence[int] | None = None,
    share: float = 0.3,
) -> "HistGradientBoostingClassifier":
    """Fit a classifier of P(event in span | alive at its start).

    Parameters
    ----------
    features : array, shape (n, p)
        NaN where unknown.
    remaining, failed : array, shape (n,)
        As in `at_risk`.
    seed : int
        Draws which (row, span) samples are kept.
    rises : sequence of int, optional
        For each feature 1 where physics lets the hazard only rise with it, -1 where only fall, 0 where either.
    share : float
        Share of the samples kept, for neighbours along a life are nearly equal.
    """
    from sklearn.ensemble import HistGradientBoostingClassifier  # noqa: PLC0415 (a night fits none)

    row, span, is_event, exposure = at_risk(remaining, failed)
    is_sampled = np.random.default_rng(seed).random(row.size) < share
    row = row[is_sampled]
    span = span[is_sampled]
    is_event = is_event[is_sampled]
    exposure = exposure[is_sampled]
    model = HistGradientBoostingClassifier(
        max_iter=150,
        learning_rate=0.08,
        max_leaf_nodes=12,
        min_samples_leaf=400,
        max_features=0.4,
        l2_regularization=1.0,
        early_stopping=False,
        random_state=seed,
        monotonic_cst=None if rises is None else [*rises, 0],
    )
    with _threads().limit(limits=1, user_api="openmp"):
        return model.fit(with_span(features[row], span), is_event, sample_weight=exposure)


@cache  # to find the libraries takes 7 ms
def _threads() -> ThreadpoolController:
    """Return a controller that limits boosting to one thread: on a busy machine threads spin at ten times the cost."""
    return ThreadpoolController()


def hazards(models: Sequence["HistGradientBoostingClassifier"], features: Array) -> Array:
    """Predict P(event in span | alive at its start), the mean over the models, shape (n, SPANS)."""
    hazard = np.empty((features.shape[0], SPANS))
    with _threads().limit(limits=1, user_api="openmp"):
        for first in range(0, len(hazard), ROWS_AT_ONCE):
            chunk = features[first : first + ROWS_AT_ONCE]
            hazard[first : first + ROWS_AT_ONCE] = sum(probabilities(m, chunk, EDGES[1:]) for m in models) / len(models)
    return hazard


def probabilities(model: "HistGradientBoostingClassifier", features: Array, spans: Array) -> Array:
    """Predict P(event) of each row for each value of the model's last input, shape (n, spans).

    Only trees that split on the span are evaluated again: a fourth of them does not, the others cut it in two to six,
    so 16 spans cost little more than two. The sums are those of scikit-learn's public `predict_proba` to the last bit.

    Parameters
    ----------
    features : array, shape (n, p)
        All inputs but the last; NaN where unknown.
    spans : array, shape (m,)
        Values of the last one, rising.
    """
    try:
        return _by_tree(model, features, spans)
    except (AttributeError, TypeError):  # the trees are scikit-learn's own and may look otherwise in another version
        return _row_by_row(model, features, spans)


def _row_by_row(model: "HistGradientBoostingClassifier", features: Array, spans: Array) -> Array:
    """Predict by the public method: every row once for each span."""
    rows = np.column_stack([np.repeat(features, spans.size, axis=0), np.tile(spans, len(features))])
    return np.asarray(model.predict_proba(rows)[:, 1]).reshape(-1, spans.size)


def _by_tree(model: "HistGradientBoostingClassifier", features: Array, spans: Array) -> Array:
    bitsets, places = model._bin_mapper.make_known_categories_bitsets()
    rows = np.column_stack([features, np.empty(len(features))])
    raw = np.full((spans.size, len(features)), float(model._baseline_prediction.item()))
    groups_of_trees = _span_groups(model, features.shape[1], tuple(spans.tolist()))
    for (tree,), groups in zip(model._predictors, groups_of_trees, strict=True):
        for group in groups:
            rows[:, -1] = spans[group][0]
            raw[group] += tree.predict(rows, bitsets, places, 1)
    return np.asarray(expit(raw.T))


@lru_cache(maxsize=8)  # a few hundred rows are predicted in less time than it takes to search the trees
def _span_groups(model: "HistGradientBoostingClassifier", last: int, spans: tuple[float, ...]) -> list[list[Array]]:
    """Group, for each tree, the spans with the same prediction; a value goes left where it is not above."""
    groups = []
    for (tree,) in model._predictors:
        splits = tree.nodes[(tree.nodes["is_leaf"] == 0) & (tree.nodes["feature_idx"] == last)]
        group = np.searchsorted(np.unique(splits["num_threshold"]), np.array(spans))
        groups.append([group == g for g in np.unique(group)])
    return groups


def event_by(hazard: Array) -> Array:
    """Compute P(event within EDGES flights), shape (n, SPANS + 1), from 0 at no flights."""
    alive = np.cumprod(1.0 - hazard, axis=1)
    return np.concatenate([np.zeros((hazard.shape[0], 1)), 1.0 - alive], axis=1)


def passage_hazards(by: Array, ahead: Sequence[float]) -> Array:
    """Compute hazards of a first passage from P(event) within each of `ahead` flights. (n, SPANS)

    Linear between those horizons. NaN where one is not known.

    Examples
    --------
    >>> hazard = passage_hazards(np.array([[0.5, 0.5, 0.75, 1.0]]), (50.0, 100.0, 200.0, 300.0))
    >>> float(event_by(hazard)[0, EDGES.tolist().index(150.0)])
    0.625
    """
    horizons = np.array([0.0, *ahead])
    rising = np.maximum.accumulate(by, axis=1)
    at_edges = [np.interp(EDGES, horizons, [0.0, *row]) for row in rising]
    alive = np.clip(1.0 - np.reshape(at_edges, (-1, EDGES.size)), _LEAST_ALIVE, 1.0)
    return np.asarray(1.0 - alive[:, 1:] / alive[:, :-1])


def quantile(by: Array, level: float) -> Array:
    """Compute the flights within which the event has probability `level`, linear between edges, up to the last."""
    rising = by + 1e-9 * np.arange(by.shape[1])
    j = np.clip((rising < level).sum(axis=1), 1, by.shape[1] - 1)
    rows = np.arange(by.shape[0])
    low = rising[rows, j - 1]
    high = rising[rows, j]
    share = np.clip((level - low) / (high - low), 0.0, 1.0)
    return np.asarray(EDGES[j - 1] + share * (EDGES[j] - EDGES[j - 1]))


def position(by: Array, remaining: Array) -> Array:
    """Compute the probability that the event comes by `remaining` flights (the probability integral transform)."""
    j = np.clip(np.searchsorted(EDGES, remaining, side="left"), 1, by.shape[1] - 1)
    rows = np.arange(by.shape[0])
    share = np.clip((remaining - EDGES[j - 1]) / (EDGES[j] - EDGES[j - 1]), 0.0, 1.0)
    return np.asarray(by[rows, j - 1] + share * (by[rows, j] - by[rows, j - 1]))


def events_ahead(by: Array) -> dict[str, Array]:
    """Compute P(event) within each of `AHEAD` flights, linear between edges, by column of `prognoses`.

    Examples
    --------
    >>> by = np.concatenate([[0.0, 0.1, 0.2, 0.3, 0.4, 0.6], np.full(11, 0.6)])[None, :]
    >>> float(events_ahead(by)["p_event_25"][0])  # half way between 20 and 30 flights
    0.5
    """
    return {f"p_event_{k}": position(by, np.full(len(by), float(k))) for k in AHEAD}
