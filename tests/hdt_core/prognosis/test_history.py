"""Features are what they are called, and know nothing of the future."""

import numpy as np
import pytest

from hdt_core.prognosis.history import FEATURES, history


def track(rows: int = 3, flights: int = 200) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.cumsum(0.004 * rng.gamma(1.0, 1.0, (rows, flights)), axis=1) + 0.01 * rng.standard_normal((rows, flights))


def features(level: np.ndarray) -> dict[str, np.ndarray]:
    age = np.broadcast_to(np.arange(level.shape[1], dtype=float), level.shape)
    return history(level, np.full_like(level, 0.02), age, np.clip(level, 0.0, 1.0))


def test_names_are_the_declared_ones():
    assert set(features(track())) == set(FEATURES)


@pytest.mark.parametrize("cut", [1, 6, 50, 150])
def test_nothing_from_the_future(cut):
    level = track()
    whole, early = features(level), features(level[:, :cut])
    for name in FEATURES:
        np.testing.assert_allclose(whole[name][:, :cut], early[name], atol=1e-9, err_msg=name)


def test_a_straight_line_is_read_exactly():
    level = np.broadcast_to(0.1 + 0.003 * np.arange(150.0), (1, 150))
    said = features(level)
    for name in ("slope_10", "slope_30", "slope_100", "slope_segment", "slope_life"):
        assert said[name][0, 140] == pytest.approx(0.003, rel=1e-6)
    assert said["left_linear_30"][0, 140] == pytest.approx((1.0 - level[0, 140]) / 0.003, rel=1e-6)


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_a_power_law_is_extrapolated_to_its_end(power):
    n = np.arange(1.0, 301.0)
    left = features(((n / 400.0) ** power)[None, :])["left_power"][0, 250]
    assert left == pytest.approx(400.0 - 251.0, rel=0.25)


def test_a_wash_starts_a_new_stretch():
    level = np.concatenate([np.linspace(0.0, 0.6, 100), 0.2 + np.linspace(0.0, 0.3, 50)])[None, :]
    said = features(level)
    assert said["slope_segment"][0, -1] == pytest.approx(0.3 / 49, rel=0.1)
    assert said["peak"][0, -1] == pytest.approx(0.6)
