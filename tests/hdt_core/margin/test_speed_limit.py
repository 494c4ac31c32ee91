"""The speed limit: where the exit pressure falls short of its schedule."""

import numpy as np
import pytest

from hdt_core.margin.control_schedules import SpeedLimit, speed_limit

CALM = np.tile([0.01, -0.01], 500)
"""Exit pressure about its schedule; its spread is .014826."""


def near_the_limit(short: int, near: int, by_sd: float) -> SpeedLimit:
    """A thousand samples at 3000 rad/s and `near` of them at 4000 or just below, `short` of which lack pressure."""
    speed = np.concatenate([np.full(1000, 3000.0), np.linspace(3980.01, 4000.0, near)])
    lack = np.where(np.arange(near) < short, -by_sd * 0.014826, 0.0)
    return speed_limit(speed, np.concatenate([CALM, lack]))


def test_a_quarter_of_the_samples_and_five_lack_four_deviations():
    assert near_the_limit(5, 20, 4.01).at_limit
    assert not near_the_limit(5, 20, 3.99).at_limit
    assert not near_the_limit(4, 12, 4.01).at_limit
    assert not near_the_limit(5, 21, 4.01).at_limit


def test_the_limit_is_the_median_of_what_is_near_it_and_ten_strays_are_passed_over():
    speed = np.concatenate([np.full(1000, 3000.0), [3979.9], np.full(25, 3990.0), np.full(16, 4000.0), [5000.0] * 10])
    lack = np.concatenate([CALM, np.full(42, -0.2), np.zeros(10)])
    assert speed_limit(speed, lack) == SpeedLimit(4000.0, at_limit=True)
    assert speed_limit(speed, 0.0 * lack) == SpeedLimit(4000.0, at_limit=False)


def test_fewer_samples_than_strays_tell_nothing():
    speed, beyond = np.arange(1.0, 13.0), np.zeros(12)
    assert speed_limit(speed, beyond) == SpeedLimit(2.0, at_limit=False)
    assert speed_limit(speed[:11], beyond[:11]) == SpeedLimit(1.0, at_limit=False)
    assert speed_limit(speed[:10], beyond[:10]) == SpeedLimit()


def test_a_gap_and_a_machine_at_rest_do_not_count():
    speed = np.concatenate([np.arange(1.0, 11.0), [0.0, np.nan, 50.0]])
    beyond = np.concatenate([np.zeros(12), [np.nan]])
    assert speed_limit(speed, beyond) == SpeedLimit()


def flown(rng: np.random.Generator, limit_rad_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Speeds held below a limit, read with their noise, and how far the pressure is beyond its schedule."""
    needed_rad_s = 3500.0 + 330.0 * rng.standard_normal(40_000)
    limited = np.minimum(needed_rad_s, limit_rad_s)
    beyond = 2.0 * np.log(limited / needed_rad_s) + 0.004 * rng.standard_normal(limited.size)
    return limited * (1.0 + 0.001 * rng.standard_normal(limited.size)), beyond


@pytest.mark.parametrize("seed", range(3))
def test_the_limit_of_a_noisy_record(seed):
    limit = speed_limit(*flown(np.random.default_rng(seed), 4400.0))
    assert limit.at_limit
    assert limit.rad_s == pytest.approx(4400.0, rel=0.002)
    assert not speed_limit(*flown(np.random.default_rng(seed), 9000.0)).at_limit
