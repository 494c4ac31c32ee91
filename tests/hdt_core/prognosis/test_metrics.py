"""Scores whose value is known."""

import numpy as np
import polars as pl
import pytest

from benchmarks.prognosis import calibration
from hdt_core.prognosis.metrics import (
    alpha_lambda,
    auc,
    brier_skill,
    constant_interval_score,
    interval_score,
    score_prognoses,
)  # fmt: skip


def test_interval_score_is_proper():
    truth = np.random.default_rng(0).standard_normal(20000)
    honest = interval_score(truth, np.full_like(truth, -1.645), np.full_like(truth, 1.645)).mean()
    for half in (0.8, 1.2, 2.2, 3.0):
        assert interval_score(truth, np.full_like(truth, -half), np.full_like(truth, half)).mean() > honest
    assert constant_interval_score(truth) == pytest.approx(honest, rel=0.01)


def test_base_rate_has_no_skill_and_certainty_has_all():
    y = np.array([1.0, 0.0, 0.0, 0.0])
    assert brier_skill(y, np.full(4, 0.25)) == pytest.approx(0.0)
    assert brier_skill(y, y) == 1.0


def test_auc_counts_pairs():
    assert auc([1, 1, 0, 0], [0.9, 0.4, 0.5, 0.1]) == 0.75
    assert auc([1, 0], [0.5, 0.5]) == 0.5


def test_alpha_lambda():
    truth, forecast = np.array([100.0, 50.0, 10.0, 1.0]), np.array([150.0, 55.0, 11.0, 1.0])
    assert alpha_lambda(truth, forecast) == 0.75


def test_calibration_of_honest_probabilities():
    rng = np.random.default_rng(1)
    p = rng.random(50000)
    table = calibration(rng.random(50000) < p, p)
    np.testing.assert_allclose(table["observed"], table["predicted"], atol=0.03)


def test_where_every_unit_outlived_the_figures_of_failures_are_left_out():
    prognoses = pl.DataFrame(
        {
            "remaining": [320.0, 400.0],
            "rul_flights": [280.0, 300.0],
            "rul_low": [150.0, 200.0],
            "rul_high": [300.0, 300.0],
        }
    ).with_columns(failed=False, life=pl.Series([0, 1]), event_50=0.0, p_event_50=0.01)
    scores = score_prognoses(prognoses)
    assert scores["mae_flights"] == 10.0
    assert scores["coverage"] == 1.0
    assert not {"interval_skill", "coverage_last_100", "alpha_lambda_20", "brier_skill"} & scores.keys()
