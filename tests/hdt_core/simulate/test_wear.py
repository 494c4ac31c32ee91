"""Wear keeps to the shapes it is named for."""

import numpy as np
import pytest

from hdt_core.simulate.wear import SHAPES, WearSettings, draw_wear


def population(shape: str, units: int = 200, flights: int = 500, **kw: float) -> np.ndarray:
    shares = tuple(float(s == shape) for s in SHAPES)
    settings = WearSettings(shape_shares=shares, rate_log_sd=0.0, **({"clog_rate": 0.0} | kw))
    return draw_wear(np.random.default_rng(3), np.zeros(units), flights, settings).loss


@pytest.mark.parametrize("shape", SHAPES)
def test_wear_never_heals_and_stays_a_fraction(shape):
    loss = population(shape)
    assert (np.diff(loss, axis=1) >= -1e-12).all()
    assert loss.min() >= 0.0
    assert loss.max() <= 0.95


@pytest.mark.parametrize(("shape", "sign"), [("accelerating", 1), ("asymptotic", -1), ("falling_rate", -1)])
def test_shapes_bend_the_way_their_names_say(shape, sign):
    loss = population(shape)
    first, second = loss[:, 250] - loss[:, 0], loss[:, 499] - loss[:, 250]
    worn = loss[:, 499] < 0.85
    assert np.mean(sign * (second - first)[worn] > 0) > 0.95


def test_nominal_life_ends_at_the_reference_loss():
    loss = population("linear", life_log_sd=0.0, life_median_flights=400.0)
    assert np.median(loss[:, 400]) == pytest.approx(0.42, rel=0.02)


def test_clogs_come_at_their_rate():
    settings = WearSettings(life_median_flights=1e9, clog_rate=1 / 1000, shape_shares=(1.0, 0, 0, 0, 0))
    clog = draw_wear(np.random.default_rng(0), np.zeros(400), 500, settings).clog
    started = (np.diff(clog, axis=1) > 0.015).sum() / 3
    assert started == pytest.approx(200, rel=0.25)


def test_same_generator_state_same_lives():
    one, two = (draw_wear(np.random.default_rng(5), np.zeros(5), 50, WearSettings()).loss for _ in range(2))
    np.testing.assert_array_equal(one, two)
