"""First passage by its formula and by lives drawn one by one; what a pack's flights asked of late; reference air."""

from itertools import pairwise
from math import exp, hypot, sqrt
from statistics import NormalDist

import numpy as np
import polars as pl
import pytest

from hdt_core.margin.exchanger_demand import CRITICAL, EXCESS_K
from hdt_core.margin.first_passage import (
    DEMAND_NAMES,
    PASSAGES,
    demand_quantiles,
    passage,
    passages,
    repeated_demand,
    wear_rate,
)
from hdt_core.physics.air import hot_day_tat_k, reference_air

WEIGHTS = (0.65, 0.2, 0.075, 0.04, 0.025, 0.01)
"""Flights that the quantiles .5, .8, .9, .95, .98 and 1 stand for: to half the way to the next."""
EDGES = (0.0, 10.0, 25.0, 50.0, 100.0, 150.0, 200.0, 300.0)
NORMAL = NormalDist()


def rate_by_hand(slope: float, flights: float, usual: float = 0.0012, usual_sd: float = 0.0012) -> tuple[float, float]:
    """A slope over n flights with scatter .010 has variance 12 s2 / n3; units differ by a quarter of their spread."""
    error2 = 12.0 * 0.010**2 / flights**3 + (0.25 * usual_sd) ** 2
    precision = 1.0 / error2 + 1.0 / usual_sd**2
    return (slope / error2 + usual / usual_sd**2) / precision, sqrt(1.0 / precision)


def passage_by_hand(ratio: float, sd: float, levels: list[float], rate: float, rate_sd: float) -> list[float]:
    """P(message by each of `EDGES`): a flight asks for more than is left with P = sum of w Phi((level - left) / sd)."""
    rates = [max(0.0, rate + rate_sd * NORMAL.inv_cdf(p)) for p in (0.1, 0.3, 0.5, 0.7, 0.9)]
    log_alive = [0.0] * 5
    by = [0.0]
    for low, high in pairwise(EDGES):
        for i, r in enumerate(rates):
            left = ratio - r * (low + high) / 2.0
            off = ((level - left) / hypot(sd, 0.03) for level in levels)
            p_flight = sum(w * NORMAL.cdf(z) for w, z in zip(WEIGHTS, off, strict=True))
            log_alive[i] -= p_flight * (high - low)
        by.append(1.0 - sum(map(exp, log_alive)) / 5.0)
    return by


def passage_of(ratio: float, sd: float, rate: float, rate_sd: float, edges: np.ndarray) -> np.ndarray:
    """Of one pack, by each edge."""
    left, wear = (np.array([pair]).T for pair in ((ratio, sd), (rate, rate_sd)))
    return passage(*left, np.array([LEVELS]), *wear, edges)[0]


LEVELS = [-0.60, -0.50, -0.46, -0.44, -0.42, -0.38]


@pytest.mark.parametrize(
    ("ratio", "sd", "rate", "rate_sd"), [(-0.3, 0.012, 0.0008, 0.0005), (-0.25, 0.04, 0.0002, 0.001)]
)
def test_passage_matches_formula(ratio, sd, rate, rate_sd):
    by = passage_of(ratio, sd, rate, rate_sd, np.array(EDGES))
    assert by.tolist() == pytest.approx(passage_by_hand(ratio, sd, LEVELS, rate, rate_sd), abs=1e-12)


def test_passage_matches_drawn_lives():
    """The share of lives that met a message."""
    rng = np.random.default_rng(2)
    shape = (4000, 300)
    wear = np.maximum(rng.normal(0.0006, 0.0002, (4000, 1)), 0.0) * (np.arange(300) + 0.5)
    demand = rng.choice(LEVELS, shape, p=WEIGHTS) + rng.normal(0.0, hypot(0.012, 0.03), shape)
    share_met = np.maximum.accumulate(demand > -0.25 - wear, axis=1).mean(axis=0)
    by = passage_of(-0.25, 0.012, 0.0006, 0.0002, np.arange(0.0, 301.0))
    np.testing.assert_allclose(by[1:], share_met, atol=0.03)
    assert 0.3 < share_met[-1] < 0.95


@pytest.mark.parametrize(("flights", "same"), [(0.0, 2.0), (500.0, 60.0)])
def test_rate_counts_two_to_sixty_flights(flights, same):
    rate, sd = wear_rate(np.full(2, 0.005), np.array([flights, same]))
    assert (rate[0], sd[0]) == (rate[1], sd[1])


@pytest.mark.parametrize("flights", [2.0, 3.0, 20.0, 60.0])
@pytest.mark.parametrize("usual", [(), (0.003, 0.0004)], ids=["prior", "own"])
def test_slope_counts_by_variance(flights, usual):
    rate, sd = wear_rate(np.array([0.005]), np.array([flights]), *usual)
    assert (rate[0], sd[0]) == pytest.approx(rate_by_hand(0.005, flights, *usual), rel=1e-9)


def one_pack(**columns: list[float | None]) -> pl.DataFrame:
    n = len(next(iter(columns.values())))
    own = {"operator": "TST", "tail": "T", "pack": 1, "flight_id": [f"F{k}" for k in range(n)]}
    return pl.DataFrame(own | columns)


def test_passages_follow_message_rule():
    flights = one_pack(
        hx_ln_ua_ratio=[-0.05, 0.15, 0.20, 0.10], hx_fouling=[0.1, 0.1, 0.9, 0.2],
        hx_fouling_slope_100_per_flight=[0.001, None, 0.0004, 0.0006], flights_since_drop=[5, 50, 29, 200],
    )  # fmt: skip
    # critical ratios fall by .026 a kelvin; the rule is 7 K, twice in three flights
    level = [-0.10, -0.06, -0.04, -0.08]
    demand = flights.select("operator", "tail", "pack", "flight_id").with_columns(
        pl.Series(name, level) - 0.026 * (e - 7.0) for name, e in zip(CRITICAL[:5], EXCESS_K, strict=True)
    )
    by = passages(flights, demand)
    assert by.columns == ["operator", "tail", "flight_id", "pack", *PASSAGES]
    assert by.select(PASSAGES).row(0) == (None, None)
    # -.10, -.06, -.08: the lower of a flight's and the most of the two before; half, a third of the window each
    windows = ([-0.10] * 6, [-0.10] + [-0.06] * 5, [-0.08] + [-0.06] * 5)
    rates = (rate_by_hand(0.0, 2.0), rate_by_hand(0.0004 / 0.2, 30.0), rate_by_hand(0.0006 / 0.8, 60.0))
    for row, ratio, levels, rate in zip((1, 2, 3), (0.15, 0.20, 0.10), windows, rates, strict=True):
        hand = passage_by_hand(ratio, 0.012, levels, *rate)
        assert by.select(PASSAGES).row(row) == pytest.approx((hand[4], hand[7]), abs=1e-9)
        assert hand[4] < 0.9


def test_no_flights_have_no_passage():
    columns = {"hx_ln_ua_ratio": [0.0], "hx_fouling": [0.0], "hx_fouling_slope_100_per_flight": [0.0]}
    none = one_pack(**columns, flights_since_drop=[1]).clear()
    keys = none.select("operator", "tail", "pack", "flight_id")
    demand = keys.with_columns(pl.lit(0.0).alias(n) for n in CRITICAL[:5])
    assert passages(none, demand).columns == ["operator", "tail", "flight_id", "pack", *PASSAGES]


@pytest.mark.parametrize(("flight", "trend"), [(138, 0.0), (139, 1.0)])
def test_trend_needs_140_flights(flight, trend):
    critical = np.where(np.arange(200) < 40, 0.0, 1.0)
    assert of_flight(critical, flight)[-1] == trend


@pytest.mark.parametrize(
    ("flight", "quantiles"),
    [(0, [np.nan] * 9), (1, [3.0] * 8 + [0.0]), (4, [3.0, 5.0, 5.0, 5.0, 5.0, 5.0, 3.0, 5.0, 0.0])],
)
def test_few_flights_stand_for_window(flight, quantiles):
    """3, 1, 5 over and over."""
    critical = np.array([np.nan, 3.0, np.nan, 1.0, 5.0])
    np.testing.assert_array_equal(of_flight(critical, flight), quantiles)


def test_demand_is_of_own_unit():
    critical = np.array([[1.0, 2.0, 9.0], [np.nan, 7.0, 8.0]])
    most = demand_quantiles(critical, np.array([0, 1, 1]), np.array([1, 0, 1]))["asked_100"]
    assert most.tolist() == pytest.approx([2.0, np.nan, 7.0], nan_ok=True)


@pytest.mark.parametrize(
    ("rule", "repeated"),
    [
        ({}, [np.nan, -0.5, -0.4, -0.3, -0.9, -0.3]), ({"of": 4}, [np.nan, -0.5, -0.4, -0.3, -0.9, -0.3]),
        ({"of": 2}, [np.nan, -0.5, -0.4, -0.4, -0.9, -0.9]), ({"of": 1}, [-0.5, -0.1, -0.4, -0.3, -0.9, -0.2]),
    ],
    ids=["default", "of four", "of two", "once"],
)  # fmt: skip
def test_demand_must_repeat(rule, repeated):
    critical = np.array([[-0.5, -0.1, -0.4, -0.3, -0.9, -0.2]])
    np.testing.assert_array_equal(repeated_demand(critical, **rule)[0], repeated)


def of_flight(critical: np.ndarray, flight: int) -> list[float]:
    values = demand_quantiles(critical[None, :], np.array([0]), np.array([flight]))
    assert tuple(values) == DEMAND_NAMES
    return [float(values[name][0]) for name in DEMAND_NAMES]


def test_demand_quantiles_by_hand():
    """Windows of 150 and of 40 flights, a trend over 100."""
    critical = np.random.default_rng(4).permutation(400) / 100.0
    window, recent = (np.sort(critical[first:351]) for first in (201, 311))
    quantiles = [*window[[74, 119, 134, 142, 146, 149]], *recent[[20, 35]]]
    trend = critical[311:351].mean() - critical[211:251].mean()
    assert of_flight(critical, 350) == pytest.approx([*quantiles, trend])


RAM_K = 1.0 + 0.2 * 0.84**2


def test_reference_cruise_is_standard():
    """11 km at Mach 0.84."""
    air = {name: values.tolist() for name, values in reference_air(2).items()}
    expected = {
        "altitude_m": [11_000.0] * 2, "mach": [0.84] * 2, "tat_k": pytest.approx([216.65 * RAM_K] * 2),
        "total_pressure_pa": pytest.approx([22_632.0 * RAM_K**3.5] * 2, rel=1e-4),
    }  # fmt: skip
    assert {name: air[name] for name in expected} == expected


def test_other_level_has_its_pressure():
    static_pa = 22_632.0 * np.exp(-9.80665 * (12_497.0 - 11_000.0) / (287.053 * 216.65))
    assert reference_air(1, 12_497.0)["total_pressure_pa"][0] == pytest.approx(static_pa * RAM_K**3.5, rel=1e-4)


def test_hot_day_is_fifteen_kelvin_warmer():
    hot = hot_day_tat_k(np.array([9000.0]), np.array([0.8]))
    assert hot[0] == pytest.approx((288.15 - 0.0065 * 9000.0 + 15.0) * (1.0 + 0.2 * 0.8**2))


def test_unknown_demand_does_not_count():
    demand = np.random.default_rng(3).uniform(-0.5, 0.0, 60)
    with_gap = np.r_[demand, np.full(80, np.nan)]

    assert of_flight(with_gap, 139) == of_flight(demand, 59)
