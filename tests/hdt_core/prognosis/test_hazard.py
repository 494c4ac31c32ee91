"""Survival arithmetic against cases with a known answer."""

import numpy as np
import pytest

from hdt_core.prognosis.hazard import (
    EDGES,
    SPANS,
    _by_tree,
    _row_by_row,
    event_by,
    fit_hazard,
    hazards,
    position,
    quantile,
)


def test_position_undoes_quantile():
    by = event_by(np.random.default_rng(0).uniform(0.01, 0.4, (50, SPANS)))
    at = quantile(by, 0.3)
    inside = by[:, -1] > 0.3
    np.testing.assert_allclose(position(by, at)[inside], 0.3, atol=1e-6)


def test_learned_hazard_recovers_a_known_one_in_spite_of_censoring():
    rng = np.random.default_rng(1)
    rate = np.exp(rng.uniform(np.log(0.003), np.log(0.03), 8000))
    death, cut = rng.exponential(1.0 / rate), rng.uniform(0.0, 200.0, 8000)
    model = fit_hazard(np.log(rate)[:, None], np.minimum(death, cut), death <= cut, seed=0)
    for true_rate in (0.005, 0.01, 0.02):
        near = np.log(true_rate) + np.linspace(-0.2, 0.2, 200)[:, None]
        p_50 = event_by(hazards([model], near))[:, EDGES.tolist().index(50.0)].mean()
        assert p_50 == pytest.approx(1.0 - np.exp(-true_rate * 50.0), abs=0.04)


def test_trees_asked_once_a_cut_say_what_each_row_and_span_asked_alone_says():
    rng = np.random.default_rng(4)
    rate = np.exp(rng.uniform(np.log(0.003), np.log(0.03), 4000))
    model = fit_hazard(np.log(rate)[:, None], rng.exponential(1.0 / rate), np.ones(4000, bool), seed=0)
    features = np.where(rng.random((500, 1)) < 0.1, np.nan, np.log(rng.choice(rate, (500, 1))))
    assert np.array_equal(_by_tree(model, features, EDGES[1:]), _row_by_row(model, features, EDGES[1:]))
