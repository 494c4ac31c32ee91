"""What a pack's flights asked of late, against sorted lists."""

import numpy as np
import pytest

from hdt_core.margin.conditions import DEMAND_NAMES, demand_quantiles, repeated_demand


def of_flight(critical: np.ndarray, flight: int) -> list[float]:
    values = demand_quantiles(critical[None, :], np.array([0]), np.array([flight]))
    assert tuple(values) == DEMAND_NAMES
    return [float(values[name][0]) for name in DEMAND_NAMES]


def test_quantiles_of_150_flights_and_of_40_and_the_trend_over_100():
    critical = np.random.default_rng(4).permutation(400) / 100.0
    window, recent = np.sort(critical[201:351]), np.sort(critical[311:351])
    quantiles = [window[i] for i in (74, 119, 134, 142, 146, 149)] + [recent[i] for i in (20, 35)]
    trend = critical[311:351].mean() - critical[211:251].mean()
    assert of_flight(critical, 350) == pytest.approx([*quantiles, trend])


def test_no_trend_before_140_flights():
    critical = np.where(np.arange(200) < 40, 0.0, 1.0)
    assert of_flight(critical, 138)[-1] == 0.0
    assert of_flight(critical, 139)[-1] == 1.0


def test_few_flights_stand_for_the_window_and_a_gap_for_the_flight_before():
    critical = np.array([np.nan, 3.0, np.nan, 1.0, 5.0])
    assert np.isnan(of_flight(critical, 0)).all()
    assert of_flight(critical, 1) == [3.0] * 8 + [0.0]
    # 3, 3, 1, 5 over and over
    assert of_flight(critical, 4) == [3.0, 5.0, 5.0, 5.0, 5.0, 5.0, 3.0, 5.0, 0.0]


def test_packs_are_told_apart_and_later_flights_do_not_count():
    critical = np.array([[1.0, 2.0, 9.0], [np.nan, 7.0, 8.0]])
    most = demand_quantiles(critical, np.array([0, 1, 1]), np.array([1, 0, 1]))["asked_100"]
    assert most.tolist() == pytest.approx([2.0, np.nan, 7.0], nan_ok=True)


def test_two_hot_flights_of_some_ask_for_the_lower_of_them():
    critical = np.array([[-0.5, -0.1, -0.4, -0.3, -0.9, -0.2]])
    assert repeated_demand(critical)[0, 1:].tolist() == [-0.5, -0.4, -0.3, -0.9, -0.3]
    assert repeated_demand(critical, of=4)[0, 1:].tolist() == [-0.5, -0.4, -0.3, -0.9, -0.3]
    assert repeated_demand(critical, of=2)[0, 1:].tolist() == [-0.5, -0.4, -0.4, -0.9, -0.9]
    assert np.isnan(repeated_demand(critical)[0, 0])
    assert repeated_demand(critical, of=1).tolist() == critical.tolist()
