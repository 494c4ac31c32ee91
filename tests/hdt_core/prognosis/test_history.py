"""Features of hand-made tracks are what they are called, and know nothing of the future."""

from dataclasses import fields

import numpy as np
import pytest

from hdt_core.margin.first_passage import LEVELS, passage, wear_rate
from hdt_core.prognosis.history import FEATURES, RECORD, RISES, UNITS_AT_ONCE, Panel, feature_rows, record_rows


def record(level: np.ndarray, **more: np.ndarray) -> dict[str, np.ndarray]:
    """Of one unit, at every flight."""
    n = len(level)
    columns = {"level": level, "sd": np.full(n, 0.02),
               "age": np.arange(n) + 3.0, "ratio": np.full(n, -0.1),
               "overheat_k": np.zeros(n), "overheat_half_k": np.zeros(n), "full_open": np.zeros(n),
               "day": np.full(n, 91.3125)}  # fmt: skip
    panel = Panel(*(np.asarray(v, float)[None, :] for v in (columns | more).values()))
    return dict(zip(RECORD, record_rows(panel, (np.zeros(n, int), np.arange(n))).T, strict=True))


def slope(level: np.ndarray, first: int, last: int) -> float:
    return float(np.polyfit(np.arange(first, last + 1), level[first : last + 1], 1)[0])


WAVY = 0.1 + 1e-3 * np.arange(120) + 0.01 * np.sin(0.7 * np.arange(120))


@pytest.fixture(scope="module")
def wavy_rows() -> dict[str, np.ndarray]:
    return record(WAVY)


@pytest.mark.parametrize("window", [10, 30, 100])
def test_slopes_are_least_squares(wavy_rows, window):
    assert wavy_rows[f"slope_{window}"][119] == pytest.approx(slope(WAVY, 120 - window, 119))
    assert wavy_rows[f"slope_{window}"][7] == pytest.approx(slope(WAVY, 0, 7))


def test_slope_of_life_needs_five_flights(wavy_rows):
    assert wavy_rows["slope_life"][119] == pytest.approx(slope(WAVY, 0, 119))
    assert wavy_rows["slope_life"][3] == 0.0 != wavy_rows["slope_life"][4]


def test_bend_is_difference_of_slopes(wavy_rows):
    assert wavy_rows["bend"][119] == pytest.approx(wavy_rows["slope_30"][119] - wavy_rows["slope_100"][119])


def test_rows_are_independent_of_others():
    """However many units are looked at together, to the last digit."""
    level = track(2 * UNITS_AT_ONCE + 3, 40)
    panel = Panel(level, *(np.full_like(level, k) for k in (0.02, 10.0, -0.3, 2.0, 1.0, 0.2, 100.0)))
    unit, flight = (i.ravel() for i in np.indices(level.shape))
    mixed = np.random.default_rng(1).permutation(unit.size)
    together = record_rows(panel, (unit[mixed], flight[mixed]))
    for k in (0, UNITS_AT_ONCE - 1, UNITS_AT_ONCE, len(level) - 1):
        alone = Panel(*(getattr(panel, f.name)[k : k + 1] for f in fields(Panel)))
        own = unit[mixed] == k
        np.testing.assert_array_equal(together[own], record_rows(alone, (np.zeros(own.sum(), int), flight[mixed][own])))


@pytest.mark.parametrize(("drop", "first"), [(0.034, 0), (0.036, 60)])
def test_stretch_begins_with_a_drop(drop, first):
    """With the last flight that lies so far below that of three flights before."""
    level = 0.2 + np.where(np.arange(100) >= 58, -drop, 0.0) + 1e-5 * np.arange(100)
    values = record(level)
    assert values["run"][99] == 100 - first
    assert values["slope_segment"][99] == pytest.approx(slope(level, first, 99), abs=1e-12)


@pytest.fixture(scope="module")
def jumps() -> dict[str, np.ndarray]:
    """Up by 0.05 at once at flight 20, half of it down again at flight 40."""
    return record(0.1 + np.where(np.arange(80) >= 20, 0.05, 0.0) - np.where(np.arange(80) >= 40, 0.025, 0.0))


@pytest.mark.parametrize(
    ("name", "flights", "expected"),
    [
        ("jump_10", [19, 20, 22, 31, 32], [0.0, 0.05, 0.05, 0.05, 0.0]),
        ("jump_largest", [19, 79], [0.0, 0.05]),
        ("peak", [19, 79], [0.1, 0.15]),
        # three flights see the step; what is above 0.02 counts, a third of it each, over the peak
        ("jump_share", [79, 20], [(0.05 - 0.02) / 0.15, (0.05 - 0.02) / 3.0 / 0.15]),
    ],
)
def test_jumps_by_hand(jumps, name, flights, expected):
    assert jumps[name][flights].tolist() == pytest.approx(expected)


def test_small_jump_has_no_share():
    assert record(np.r_[np.zeros(5), np.full(5, 0.04)] / 4.0)["jump_share"][9] == 0.0


def test_jump_share_has_least_peak():
    risen = record(np.r_[np.zeros(5), np.full(5, 0.05)] - 0.04)["jump_share"][9]
    assert risen == pytest.approx(0.03 / 0.02)


def test_entry_level_is_median_of_five():
    entry = record(np.arange(10) / 100.0)["entry_level"]
    assert entry.tolist() == pytest.approx([0.0, 0.01, 0.02, 0.03, 0.04, *[0.02] * 5])


@pytest.mark.parametrize(("flight", "first"), [(59, 30), (9, 0)])
def test_roughness_spans_thirty_flights(flight, first):
    level = np.cumsum(0.01 * np.random.default_rng(1).standard_normal(60))
    change = np.r_[0.0, np.diff(level)][first : flight + 1]
    assert record(level)["roughness"][flight] == pytest.approx(np.sqrt(np.mean(change**2)))


def test_season_follows_the_year():
    values = record(WAVY, day=np.linspace(1.0, 365.25, 120))
    assert values["season_sin"][0] == pytest.approx(np.sin(2.0 * np.pi / 365.25))
    assert values["season_cos"][119] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("name", "value"), [("age_flights", 7.0), ("seen_flights", 5.0), ("level_sd", 0.02), ("ratio", -0.1)]
)
def test_rows_hold_what_is_known(wavy_rows, name, value):
    assert wavy_rows[name][4] == value


@pytest.fixture(scope="module")
def observations() -> dict[str, np.ndarray]:
    """Overheat by the fifth and the half, and share of open door, at random; some flights show nothing."""
    rng = np.random.default_rng(2)
    hot, half, door = (rng.uniform(0.0, 6.0, 60) for _ in range(3))
    hot[[5, 55]] = np.nan
    hot[30] = 9.0
    hot[56] = 3.0
    return {"overheat_k": hot, "overheat_half_k": half, "full_open": door}


@pytest.fixture(scope="module")
def averages(observations) -> dict[str, np.ndarray]:
    return record(np.zeros(60), **observations)


@pytest.mark.parametrize(
    ("name", "signal", "first"),
    [
        ("overheat_10", "overheat_k", 50), ("overheat_40", "overheat_k", 20),
        ("overheat_half_40", "overheat_half_k", 20), ("full_open_10", "full_open", 50),
        ("full_open_40", "full_open", 20),
    ],
)  # fmt: skip
def test_averages_span_recent_flights(observations, averages, name, signal, first):
    assert averages[name][59] == pytest.approx(np.nanmean(observations[signal][first:]))


def test_first_average_is_the_flights_own(observations, averages):
    assert averages["overheat_10"][0] == pytest.approx(observations["overheat_k"][0])


def test_hot_share_counts_known_flights(observations, averages):
    recent = observations["overheat_k"][20:]
    assert averages["hot_share_40"][59] == pytest.approx((recent[np.isfinite(recent)] > 3.0).mean())


def test_most_overheat_passes_silent_flights(averages):
    assert averages["overheat_most_40"][59] == 9.0
    assert averages["overheat_most_40"][5] == averages["overheat_most_40"][4]


def test_most_overheat_lasts_forty_flights():
    once = record(np.zeros(80), overheat_k=np.where(np.arange(80) == 30, 9.0, 1.0))
    assert once["overheat_most_40"][[69, 70]].tolist() == [9.0, 1.0]


def test_silent_unit_has_no_average():
    assert np.isnan(record(np.zeros(3), overheat_k=np.full(3, np.nan))["overheat_10"]).all()


def rows(level: np.ndarray, demand: float, ratio: float, flight: int) -> dict[str, float]:
    values = record(level, ratio=np.full(len(level), ratio))
    table = np.stack([values[name] for name in RECORD], axis=1)[[flight]]
    critical = np.full((1, len(level)), demand)
    return dict(zip(FEATURES, feature_rows(table, critical, (np.array([0]), np.array([flight])))[0], strict=True))


each_flight = pytest.mark.parametrize("flight", [40, 99, 119])


@each_flight
def test_forecast_uses_last_hundred_flights(flight):
    """The wear of a fraction is larger in ln of what is left, by that."""
    values = rows(WAVY, -0.5, -0.2, flight)
    per_flight = slope(WAVY, max(flight - 99, 0), flight) / (1.0 - WAVY[flight])
    edges = np.array([0.0, 10, 25, 50, 75, 100, 150, 200, 250, 300])
    wear = wear_rate(np.array([per_flight]), np.array([flight + 1.0]))
    by = passage(np.array([-0.2]), np.array([0.012]), np.full((1, len(LEVELS)), -0.5), *wear, edges)[0]
    ahead = [values[f"passage_{k}"] for k in (50, 100, 200, 300)]
    assert ahead == pytest.approx(by[[3, 5, 7, 9]])
    assert values["passage_median"] == pytest.approx(np.interp(0.5, by, edges))


@each_flight
def test_reserve_is_ratio_above_demand(flight):
    assert rows(WAVY, -0.5, -0.2, flight)["reserve_95"] == pytest.approx(0.3, abs=1e-9)


@each_flight
@pytest.mark.parametrize("name", ["30", "100", "segment"])
def test_linear_forecast_divides_reserve_by_slope(wavy_rows, flight, name):
    want = min(max(0.3 / (wavy_rows[f"slope_{name}"][flight] / (1.0 - WAVY[flight])), 0.0), 1000.0)
    assert rows(WAVY, -0.5, -0.2, flight)[f"left_linear_{name}"] == pytest.approx(want, rel=1e-9)


RISING = 1e-3 * np.arange(50)


@pytest.mark.parametrize(
    ("level", "demand", "left"),
    [
        (0.1 + RISING, -0.1, 0.0),
        (np.full(50, 0.1), -0.5, 1000.0),
        (1e-2 * (0.1 + RISING), -0.5, 1000.0),
        (0.85 + RISING, -0.5, pytest.approx(0.3 / (1e-3 / 0.2))),  # what is left counts as a fifth at least
    ],
    ids=["no reserve", "no wear", "little wear", "worn"],
)
def test_linear_forecast_is_bounded(level, demand, left):
    assert rows(level, demand, -0.2, 49)["left_linear_30"] == left


def test_demand_beyond_ratio_fails_soon():
    level = np.broadcast_to(0.1 + 0.002 * np.arange(150.0), (1, 150))
    safe, failing = (features(level, np.full((1, 150), np.log(share))) for share in (0.2, 0.9))
    assert safe["passage_50"][0, 140] < 0.01
    assert failing["passage_50"][0, 140] > 0.99
    assert failing["passage_median"][0, 140] < 10.0 < safe["passage_median"][0, 140]


@pytest.mark.parametrize(
    ("names", "sign"),
    [
        (("reserve_95", "left_linear_30", "passage_median"), -1),
        (("passage_100", "overheat_40", "hot_share_40"), 1),
        (("level", "slope_30"), 0),
    ],
)
def test_hazard_rises_with_its_features(names, sign):
    signs = dict(zip(FEATURES, RISES, strict=True))
    assert {signs[name] for name in names} == {sign}


NAMES = {name: i for i, name in enumerate(FEATURES)}


def track(rows: int = 3, flights: int = 200) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.cumsum(0.002 * rng.gamma(1.0, 1.0, (rows, flights)), axis=1) + 0.01 * rng.standard_normal((rows, flights))


def features(level: np.ndarray, demand: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Each feature over (units, flights), each unit on a pack of its own."""
    age = np.broadcast_to(np.arange(level.shape[1], dtype=float), level.shape)
    hot = 10.0 * np.clip(level, 0.0, 1.0)
    ratio = np.log1p(-np.clip(level, 0.0, 0.9))
    panel = Panel(level, np.full_like(level, 0.02), age, ratio, hot, 0.5 * hot, 0.1 * hot, age)
    rng = np.random.default_rng(5)
    demand = -0.6 + 0.1 * rng.standard_normal((len(level), 400))[:, : level.shape[1]] if demand is None else demand
    at = tuple(i.ravel() for i in np.indices(level.shape))
    table = feature_rows(record_rows(panel, at), demand, at)
    return {name: table[:, i].reshape(level.shape) for name, i in NAMES.items()}


@pytest.mark.parametrize("cut", [1, 6, 50, 150])
def test_features_ignore_later_flights(cut):
    level = track()
    whole = features(level)
    early = features(level[:, :cut])
    for name in FEATURES:
        np.testing.assert_allclose(whole[name][:, :cut], early[name], atol=1e-9, err_msg=name)


def test_silent_flights_keep_last_averages():
    hot = np.r_[np.linspace(0.0, 6.0, 50), np.full(60, np.nan)]

    averages = record(np.zeros(110), overheat_k=hot)["overheat_40"]

    assert averages[109] == averages[49]
