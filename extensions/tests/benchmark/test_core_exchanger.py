"""The 1 Hz exchanger: its steady states are exact, and no heat is lost on the way between them."""

import numpy as np
import pytest

from hdt_benchmark.core_exchanger import CORE_EXCHANGER, core
from hdt_core.physics.heat_exchanger import HEAT_EXCHANGER, capacity_rates

AT = {"hot_flow_kg_s": 0.9, "ram_flow_kg_s": 1.6, "hot_in_k": 390.0, "cold_in_k": 250.0}


def test_steady_state_is_cross_flow():
    hold = AT | {"ram_flow_kg_s": np.full(300, 1.6)}
    end = {name: values[-1] for name, values in CORE_EXCHANGER.simulate({"hx_fouling": 0.1}, hold, 1.0).items()}
    assert end == pytest.approx(HEAT_EXCHANGER.predict({"hx_fouling": 0.1}, AT), rel=1e-12)


def test_exact_step_is_many_small_ones():
    one = CORE_EXCHANGER.advance({}, AT, {"core_k": 350.0}, 2.0)["core_k"]
    small = 350.0
    for _ in range(2000):
        small = small + 0.001 * CORE_EXCHANGER.rates(**CORE_EXCHANGER.nominal, **AT, core_k=small)
    assert one == pytest.approx(small, abs=2e-3)


@pytest.mark.parametrize("core_k", [250.0, 310.0, 390.0])
def test_core_stores_remaining_heat(core_k):
    out = CORE_EXCHANGER.predict({}, AT, {"core_k": core_k})
    hot_w_k, ratio = capacity_rates(0.9, 1.6, 390.0, HEAT_EXCHANGER.predict({}, AT)["hot_out_k"], 250.0)
    left_w = hot_w_k * (390.0 - out["hot_out_k"]) - hot_w_k / ratio * (out["ram_out_k"] - 250.0)
    rate_k_s = CORE_EXCHANGER.rates(**CORE_EXCHANGER.nominal, **AT, core_k=core_k)
    assert left_w == pytest.approx(CORE_EXCHANGER.nominal["hx_core_heat_j_k"] * rate_k_s, rel=1e-9, abs=1e-6)


@pytest.mark.parametrize(("metal_kg", "low_s", "high_s"), [(15.0, 3.0, 10.0), (30.0, 6.0, 20.0)])
def test_aluminium_settles_in_seconds(metal_kg, low_s, high_s):
    values = CORE_EXCHANGER.nominal | {"hx_core_heat_j_k": 900.0 * metal_kg}
    assert low_s < core(**values, **AT).settling_s < high_s


def test_door_step_shows_late():
    """The first second shows less than half of what a step of ram flow ends in."""
    flow = np.r_[np.full(200, 1.6), np.full(200, 2.0)]
    hot = CORE_EXCHANGER.simulate({}, AT | {"ram_flow_kg_s": flow}, 1.0)["hot_out_k"]
    share = (hot[199] - hot[200:]) / (hot[199] - hot[-1])
    assert share[0] < 0.5
    assert share[100] > 0.99
    assert np.all(np.diff(share) >= -1e-12)


THIN = AT | {"hot_flow_kg_s": 0.7, "ram_flow_kg_s": 2.0}
FOULED = CORE_EXCHANGER.nominal | {"hx_fouling": 0.2}
HOT_FILM = 1700.0 / 0.45 * (0.7 / 0.9) ** 0.6
COLD_FILM = 1700.0 / 0.45 * (2.0 / 1.6) ** 0.6
"""Films in series with a wall of a tenth: each has 0.45 of the resistance, at 0.9 and 1.6 kg/s."""


def test_core_lies_between_films():
    now = core(**FOULED, **THIN)
    hot_k, ram_k = HEAT_EXCHANGER.predict({"hx_fouling": 0.2}, THIN).values()
    hot_w_k, ratio = capacity_rates(0.7, 2.0, 390.0, hot_k, 250.0)
    heat_w = hot_w_k * (390.0 - hot_k)
    under = 0.5 * (390.0 + hot_k) - heat_w / HOT_FILM
    over = 0.5 * (250.0 + ram_k) + heat_w / COLD_FILM
    assert (now.hot_out_k, now.ram_out_k) == (hot_k, ram_k)
    assert now.steady_k == pytest.approx(0.5 * (under + over), rel=1e-9)
    cold_w_k = hot_w_k / ratio
    gains = 1.0 - np.exp(-HOT_FILM / hot_w_k), 1.0 - np.exp(-COLD_FILM / cold_w_k)
    assert (now.hot_gain, now.cold_gain) == pytest.approx(gains, rel=1e-9)
    assert now.settling_s == pytest.approx(18e3 / (hot_w_k * gains[0] + cold_w_k * gains[1]), rel=1e-9)


def test_warm_film_conducts_more():
    warm = core(**FOULED, **(THIN | {"hot_in_k": 420.0}))
    hot_w_k, _ = capacity_rates(0.7, 2.0, 420.0, warm.hot_out_k, 250.0)
    film = HOT_FILM * ((0.75 * 420.0 + 62.5) / 355.0) ** 0.38  # k^0.67 mu^-0.27 of air
    assert warm.hot_gain == pytest.approx(1.0 - np.exp(-film / hot_w_k), rel=1e-9)
