"""Boosted trees asked of the same rows once for each span: only trees that split on the span are asked again.

scikit-learn's public `predict_proba` wants a row for every span. A fourth of the trees does not look at the span, the
others cut it in two to six, so 16 spans cost little more than two; the sums are the same to the last bit.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit
from sklearn.ensemble import HistGradientBoostingClassifier

Array = NDArray[np.float64]


def probabilities(model: HistGradientBoostingClassifier, features: Array, spans: Array) -> Array:
    """P(event) of each row for each value of the model's last input, shape (n, spans).

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
    """The same by the public way: every row once for each span."""
    asked = np.column_stack([np.repeat(features, spans.size, axis=0), np.tile(spans, len(features))])
    return np.asarray(model.predict_proba(asked)[:, 1]).reshape(-1, spans.size)


def _by_tree(model: HistGradientBoostingClassifier, features: Array, spans: Array) -> Array:
    bitsets, places = model._bin_mapper.make_known_categories_bitsets()
    asked = np.column_stack([features, np.empty(len(features))])
    raw = np.full((spans.size, len(features)), float(model._baseline_prediction.item()))
    for (tree,), groups in zip(model._predictors, _alike(model, features.shape[1], tuple(spans.tolist())), strict=True):
        for alike in groups:
            asked[:, -1] = spans[alike][0]
            raw[alike] += tree.predict(asked, bitsets, places, 1)
    return np.asarray(expit(raw.T))


@lru_cache(maxsize=8)  # a few hundred rows are asked in less time than it takes to look through the trees
def _alike(model: HistGradientBoostingClassifier, last: int, spans: tuple[float, ...]) -> list[list[NDArray[np.bool_]]]:
    """For each tree the spans between which it makes no difference; a value goes left where it is not above."""
    found = []
    for (tree,) in model._predictors:
        splits = tree.nodes[(tree.nodes["is_leaf"] == 0) & (tree.nodes["feature_idx"] == last)]
        group = np.searchsorted(np.unique(splits["num_threshold"]), np.array(spans))
        found.append([group == g for g in np.unique(group)])
    return found
