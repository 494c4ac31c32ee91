"""What the controllers hold, learned: against least squares with a column for each group, and at the windows' edges."""

import json
from datetime import timedelta

import numpy as np
import polars as pl
import pytest
from alter import alter
from known_fleet import departure

from hdt_core.flight.control_schedules import (
    ALTITUDE_KNOTS_M,
    TAT_KNOTS_K,
    ControlSchedule,
    ControlSchedules,
    SpeedLimit,
    learn_schedules,
    speed_limit,
)

LAW = ControlSchedule((0.0, 10.0), {"": (0.0, 5.0), "A": (1.0, 3.0)}, {"": 0.0, "A": 2.0}, {"": 7.0, "A/1": 8.0})


def test_knots_are_as_declared():
    assert tuple(228.0 + 8.0 * k for k in range(12)) == TAT_KNOTS_K
    assert tuple(4800.0 + 800.0 * k for k in range(13)) == ALTITUDE_KNOTS_M


def test_schedule_is_read_between_knots():
    """With its gain."""
    tails = np.array(["A", "B", "A", "A"])
    x = np.array([5.0, 5.0, 20.0, np.nan])
    assert LAW.column(tails, x, np.array([1.0, 1.0, 0.5, 0.0])).to_list() == [4.0, 2.5, 4.0, None]
    assert LAW.column(tails[:2], x[:2]).to_list() == [2.0, 2.5]


def test_level_is_of_pack():
    packs = pl.DataFrame({"tail": ["A", "A", "B"], "pack": [1, 2, 1]})
    assert LAW.level_column(packs).to_list() == [8.0, 7.0, 7.0]


def test_schedule_without_shape_is_flat():
    assert ControlSchedule((0.0, 1.0), {}, {}).shape("A", np.array([0.5]), 1.0).tolist() == [0.0]


def by_columns(x: np.ndarray, third: np.ndarray, y: np.ndarray, group: np.ndarray, knots: tuple) -> np.ndarray:
    """Heights at the knots, mean zero, and gain: hats, the third reading and a column for each group; second
    differences cost ten samples each; four rounds, three of them with Huber's weights at 1.5 deviations."""
    n = len(knots)
    groups = np.unique(group)
    hats = np.array([np.interp(x, knots, row) for row in np.eye(n)]).T
    design = np.column_stack([hats, third, *(group == g for g in groups)]).astype(float)
    bend = np.zeros((n - 2, design.shape[1]))
    for i in range(n - 2):
        bend[i, i : i + 3] = 1.0, -2.0, 1.0
    ridge = np.diag([1e-6] * (n + 1) + [0.0] * len(groups))
    weight = np.ones(len(y))
    for _ in range(4):
        normal = design.T @ (weight[:, None] * design) + 10.0 * bend.T @ bend + ridge
        answer = np.linalg.solve(normal, design.T @ (weight * y))
        miss = np.abs(y - design @ answer)
        weight = np.minimum(1.0, 1.5 * 1.4826 * np.median(miss) / np.maximum(miss, 1e-12))
    return np.append(answer[:n] - answer[:n].mean(), answer[n])


def fleet(seed: int, flights: int = 30, tail: str = "A", samples: int = 10) -> pl.DataFrame:
    """Outlets that follow a bent schedule with a trim a flight, exit pressures with a pack's own level, some strays."""
    rng = np.random.default_rng(seed)
    rows = flights * samples
    tat = rng.uniform(232.0, 310.0, rows)
    altitude = rng.uniform(5000.0, 13_500.0, rows)
    flow = rng.uniform(0.5, 0.9, rows)
    trim = np.repeat(rng.normal(0.0, 2.0, flights), samples)
    outlet = 296.0 + 0.6 * np.maximum(tat - 252.0, 0.0) + trim + rng.standard_t(2, rows) * 0.3
    exit_ln = np.log(90e3) - 1e-5 * (altitude - 9000.0) + 0.15 * flow**2 + 0.003 * rng.standard_t(3, rows)
    return pl.DataFrame(
        {
            "operator": "TST", "tail": tail, "pack": 1,
            "flight_id": np.repeat([f"{k:03d}" for k in range(flights)], samples),
            "time_utc": [departure(k) + timedelta(minutes=j) for k in range(flights) for j in range(samples)],
            "phase": "cruise", "altitude_m": altitude, "tat_k": tat, "hx_out_k": outlet, "ram_door_open": 0.4,
            "pack_flow_kg_s": flow, "cc_out_pa": np.exp(exit_ln), "cc_speed_rad_s": rng.uniform(3000.0, 4000.0, rows),
        }
    )  # fmt: skip


@pytest.fixture(scope="module")
def samples() -> pl.DataFrame:
    return fleet(1)


@pytest.fixture(scope="module")
def schedules(samples) -> ControlSchedules:
    return learn_schedules(samples)


@pytest.fixture(scope="module")
def delivery(samples) -> np.ndarray:
    """The delivery's schedule by least squares."""
    altitude, out_pa, flow = (samples[c].to_numpy() for c in ("altitude_m", "cc_out_pa", "pack_flow_kg_s"))
    return by_columns(altitude, flow**2, np.log(out_pa), np.zeros(samples.height), ALTITUDE_KNOTS_M)


def test_outlet_schedule_is_least_squares(samples, schedules):
    x, y, flight = (samples[c].to_numpy() for c in ("tat_k", "hx_out_k", "flight_id"))
    outlet = by_columns(x, np.zeros(len(x)), y, flight, TAT_KNOTS_K)
    assert schedules.outlet.shapes["A"] == pytest.approx(outlet[:-1], abs=1e-4)


def test_delivery_schedule_is_least_squares(schedules, delivery):
    assert schedules.delivery.shapes["A"] == pytest.approx(delivery[:-1], abs=1e-5)
    assert schedules.delivery.gains["A"] == pytest.approx(delivery[-1], abs=1e-5)


def test_delivery_level_is_median(samples, schedules, delivery):
    scheduled = np.interp(samples["altitude_m"], ALTITUDE_KNOTS_M, delivery[:-1])
    scheduled = scheduled + delivery[-1] * samples["pack_flow_kg_s"].to_numpy() ** 2
    level = np.median(np.log(samples["cc_out_pa"].to_numpy()) - scheduled)
    assert schedules.delivery.levels["A/1"] == pytest.approx(level, abs=1e-5)
    assert schedules.delivery.levels[""] == schedules.delivery.levels["A/1"]


def test_highest_speed_is_unmet_limit(samples, schedules):
    assert schedules.speed == SpeedLimit(np.sort(samples["cc_speed_rad_s"])[-11], at_limit=False)


def test_schedules_survive_json(schedules):
    assert ControlSchedules.from_dict(json.loads(json.dumps(schedules.to_dict()))) == schedules


def test_speed_limit_shows_in_pressure(samples):
    fast = pl.int_range(pl.len()) < 30
    limited = alter(samples, fast, cc_speed_rad_s=4300.0, cc_out_pa=pl.col("cc_out_pa") * np.exp(-0.05))
    assert learn_schedules(limited).speed == SpeedLimit(4300.0, at_limit=True)


def test_limit_spans_half_a_percent():
    speed = 4300.0 * np.repeat((1.0, 1.0 - 0.0048, 1.0 - 0.0052, 0.9), (11, 20, 80, 400))
    short = np.where(speed > 4000.0, -0.05, 0.001 * np.sin(np.arange(speed.size)))
    assert speed_limit(speed, short) == SpeedLimit(4300.0 * (1.0 - 0.0048), at_limit=True)


@pytest.mark.parametrize(("n", "shapes"), [(299, {"", "A"}), (300, {"", "A", "B"})])
def test_own_law_needs_300_samples(samples, n, shapes):
    both = learn_schedules(pl.concat([samples, fleet(2, tail="B").head(n)]))
    assert set(both.outlet.shapes) == shapes
    assert set(both.outlet.levels) == {"A/1", "B/1", ""}


def test_few_samples_take_common_law(samples):
    outlet = learn_schedules(pl.concat([samples, fleet(2, tail="B").head(299)])).outlet
    assert outlet.shape("B", np.array([240.0])) == outlet.shape("", np.array([240.0]))


@pytest.mark.parametrize(("n", "is_flat"), [(23, True), (24, False)])
def test_law_needs_two_samples_a_knot(samples, n, is_flat):
    heights = set(learn_schedules(samples.head(n)).outlet.shapes[""])
    assert (heights == {0.0}) == (len(heights) == 1) == is_flat


def test_no_samples_have_no_levels(samples):
    assert learn_schedules(samples.clear()).outlet.levels == {}


@pytest.mark.parametrize(("flight", "is_learned"), [("060", False), ("059", True)])
def test_schedules_learn_from_sixty_flights(flight, is_learned):
    long = fleet(3, flights=61, samples=5)
    hot = alter(long, pl.col("flight_id") == flight, hx_out_k=pl.col("hx_out_k") + pl.col("tat_k"))
    assert (learn_schedules(hot) != learn_schedules(long)) is is_learned


@pytest.mark.parametrize(
    "change",
    [{"phase": pl.lit("climb")}, {"pack_flow_kg_s": 0.2}, {"cc_out_pa": 0.0}],
    ids=["climb", "at rest", "no pressure"],
)
def test_delivery_learns_from_running_cruise(samples, change):
    odd = pl.concat([samples.head(260), samples.tail(40).with_columns(**change)])
    assert learn_schedules(odd).delivery == learn_schedules(samples.head(260)).delivery


def test_unrecorded_speed_has_no_limit(samples, schedules):
    without = learn_schedules(samples.with_columns(cc_speed_rad_s=pl.lit(None, pl.Float64)))
    assert (without.speed, without.delivery) == (SpeedLimit(), schedules.delivery)


def test_ten_samples_give_no_schedule():
    few = learn_schedules(fleet(1, flights=2, samples=5))
    for law in (few.outlet, few.delivery):
        assert (set(law.shapes[""]), law.gains) == ({0.0}, {"": 0.0})
    assert few.speed == SpeedLimit()


CALM = np.tile([0.01, -0.01], 500)
"""Exit pressure about its schedule; its spread is .014826."""


def near_the_limit(short: int, near: int, by_sd: float) -> SpeedLimit:
    """A thousand samples at 3000 rad/s and `near` of them at 4000 or just below, `short` of which lack pressure."""
    speed = np.concatenate([np.full(1000, 3000.0), np.linspace(3980.01, 4000.0, near)])
    lack = np.where(np.arange(near) < short, -by_sd * 0.014826, 0.0)
    limit, raised = (speed_limit(speed, np.concatenate([CALM, lack]) + all_over) for all_over in (0.0, 0.05))
    assert limit == raised  # only the shortfall about the median counts
    return limit


@pytest.mark.parametrize(
    ("short", "near", "by_sd", "at_limit"),
    [(5, 20, 4.01, True), (5, 20, 3.99, False), (4, 12, 4.01, False), (5, 21, 4.01, False)],
)
def test_speed_limit_needs_quarter_of_samples(short, near, by_sd, at_limit):
    """And five, that lack four deviations about their median."""
    assert near_the_limit(short, near, by_sd).at_limit is at_limit


@pytest.mark.parametrize(("lack", "at_limit"), [(-0.2, True), (0.0, False)])
def test_limit_is_eleventh_highest_speed(lack, at_limit):
    speed = np.concatenate([np.full(1000, 3000.0), [3979.9], np.full(25, 3990.0), np.full(16, 4000.0), [5000.0] * 10])
    beyond = np.concatenate([CALM * bool(lack), np.full(42, lack), np.zeros(10)])
    assert speed_limit(speed, beyond) == SpeedLimit(4000.0, at_limit=at_limit)


@pytest.mark.parametrize(("n", "limit"), [(12, (2.0, False)), (11, (1.0, False)), (10, ())])
def test_limit_needs_eleven_samples(n, limit):
    assert speed_limit(np.arange(1.0, n + 1.0), np.zeros(n)) == SpeedLimit(*limit)


def test_invalid_speeds_do_not_count():
    speed = np.concatenate([np.arange(1.0, 11.0), [0.0, np.nan, 50.0]])
    beyond = np.concatenate([np.zeros(12), [np.nan]])
    assert speed_limit(speed, beyond) == SpeedLimit()


def noisy_speeds(rng: np.random.Generator, limit_rad_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Speeds held below a limit, read with their noise, and how far the pressure is beyond its schedule."""
    needed_rad_s = 3500.0 + 330.0 * rng.standard_normal(40_000)
    limited = np.minimum(needed_rad_s, limit_rad_s)
    beyond = 2.0 * np.log(limited / needed_rad_s) + 0.004 * rng.standard_normal(limited.size)
    return limited * (1.0 + 0.001 * rng.standard_normal(limited.size)), beyond


@pytest.mark.parametrize("seed", range(3))
def test_recovers_limit_from_noise(seed):
    limit = speed_limit(*noisy_speeds(np.random.default_rng(seed), 4400.0))
    assert limit.at_limit
    assert limit.rad_s == pytest.approx(4400.0, rel=0.002)
    assert not speed_limit(*noisy_speeds(np.random.default_rng(seed), 9000.0)).at_limit
