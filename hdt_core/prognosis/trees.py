"""Predict the same rows for each span by boosted trees; only trees that split on the span are evaluated again.

scikit-learn's public `predict_proba` takes a row for every span. A fourth of the trees does not split on the span, the
others cut it in two to six, so 16 spans cost little more than two; the sums are the same to the last bit.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit
from sklearn.ensemble import HistGradientBoostingClassifier

Array = NDArray[np.float64]


def probabilities(model: HistGradientBoostingClassifier, features: Array, spans: Array) -> Array:
    """Predict P(event) of each row for each value of the model's last input, shape (n, spans).

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


def _row_by_row(model: HistGradientBoostingClassifier, features: Array, spans: Array) -> Array:
    """Predict by the public method: every row once for each span."""
    rows = np.column_stack([np.repeat(features, spans.size, axis=0), np.tile(spans, len(features))])
    return np.asarray(model.predict_proba(rows)[:, 1]).reshape(-1, spans.size)


def _by_tree(model: HistGradientBoostingClassifier, features: Array, spans: Array) -> Array:
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
def _span_groups(
    model: HistGradientBoostingClassifier, last: int, spans: tuple[float, ...]
) -> list[list[NDArray[np.bool_]]]:
    """Group, for each tree, the spans with the same prediction; a value goes left where it is not above."""
    groups = []
    for (tree,) in model._predictors:
        splits = tree.nodes[(tree.nodes["is_leaf"] == 0) & (tree.nodes["feature_idx"] == last)]
        group = np.searchsorted(np.unique(splits["num_threshold"]), np.array(spans))
        groups.append([group == g for g in np.unique(group)])
    return groups
