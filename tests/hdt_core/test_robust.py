"""Robust statistics against normal values, whose answers are known."""

import numpy as np
import polars as pl
import pytest

from hdt_core.robust import huber_weights, median_error, spread, spread_expr

NORMAL = np.random.default_rng(5).normal(0.0, 2.0, 200_000)


def test_spread_is_the_standard_deviation_of_normal_values_and_no_stray_moves_it():
    assert spread(NORMAL) == pytest.approx(2.0, rel=0.01)
    strays = np.where(np.arange(NORMAL.size) % 20 == 0, 1e6, NORMAL)
    assert spread(strays) == pytest.approx(2.0, rel=0.1)
    assert pl.DataFrame({"x": NORMAL}).select(spread_expr(pl.col("x"))).item() == pytest.approx(spread(NORMAL))
    assert spread(np.append(NORMAL, np.nan)) == spread(NORMAL)


def test_the_error_of_a_median_is_what_medians_scatter():
    medians = np.median(NORMAL.reshape(-1, 50), axis=1)
    assert 2.0 * median_error(50.0) == pytest.approx(medians.std(), rel=0.05)


def test_hubers_location_is_95_per_cent_efficient():
    groups = NORMAL.reshape(-1, 50)
    place = np.median(groups, axis=1)
    for _ in range(20):
        weight = huber_weights(np.abs(groups - place[:, None]), 2.0)
        place = (weight * groups).sum(axis=1) / weight.sum(axis=1)
    assert groups.mean(axis=1).var() / place.var() == pytest.approx(0.95, abs=0.015)
    assert (huber_weights(np.array([0.0, 1.0]), 0.0) == [1.0, huber_weights(np.array([1.0]), 0.0)[0]]).all()
