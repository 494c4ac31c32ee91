"""The slope test finds planted ramps, and averages of a log are what they say."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from hdt_core.flight.quality import SIGNALS
from hdt_core.flight.steady import DRIVERS, WINDOW_S, average_log, drift_free, is_transient, slope_t, steady_snapshots

RAMPS_AT, RAMP_S, EDGE_S = (600, 1800, 3000), 300, WINDOW_S // 2


def planted(rise_sd: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """White noise of sd 1 with three ramps; which seconds are ramp, and which are far from any."""
    x = np.random.default_rng(seed).normal(size=3900)
    ramp, far = np.zeros(x.size, dtype=bool), np.ones(x.size, dtype=bool)
    for start in RAMPS_AT:
        x[start : start + RAMP_S] += np.linspace(0.0, rise_sd, RAMP_S)
        x[start + RAMP_S :] += rise_sd
        ramp[start : start + RAMP_S] = True
        far[start - EDGE_S : start + RAMP_S + EDGE_S] = False
    return x, ramp, far


@pytest.mark.parametrize("rise_sd", [20.0, -25.0, 60.0])
def test_finds_planted_ramps_and_leaves_steady_flight_alone(rise_sd):
    trials = [planted(rise_sd, seed) for seed in range(40)]
    found = np.concatenate([is_transient(x)[ramp] for x, ramp, _ in trials])
    false = np.concatenate([is_transient(x)[far] for x, _, far in trials])
    assert found.mean() >= 0.97
    assert false.mean() <= 0.005


def test_slope_t_is_students_t_of_a_straight_line_fit():
    x = np.random.default_rng(3).normal(size=WINDOW_S)
    time = np.arange(WINDOW_S)
    (slope, _), covariance = np.polyfit(time, x, 1, cov=True)
    assert slope_t(x)[0] == pytest.approx(slope / np.sqrt(covariance[0, 0]), rel=1e-9)


def test_shift_and_scale_change_no_verdict():
    x, _, _ = planted(20.0, 5)
    np.testing.assert_allclose(slope_t(1e4 + 3.0 * x), slope_t(x), rtol=1e-6)


@pytest.mark.parametrize("n", [0, 1, WINDOW_S - 1])
def test_record_shorter_than_a_window_has_no_slope(n):
    assert not is_transient(np.arange(float(n))).any()


def test_constant_reading_is_steady_and_toggling_of_the_last_digit_too():
    assert not is_transient(np.full(300, 251.25)).any()
    toggling = 251.25 + 0.25 * (np.arange(300) > 150)
    assert is_transient(toggling).any()
    assert not is_transient(toggling, resolution=2.0).any()


def log(drift: dict[str, float], seed: int = 4) -> pl.DataFrame:
    rng = np.random.default_rng(seed)
    second = np.arange(600)
    signals = {
        s: 1.0 + drift.get(s, 0.0) * second + DRIVERS.get(s, (0.0, 0.01))[1] * rng.normal(size=600) for s in SIGNALS
    }
    start = pl.lit(datetime(2024, 3, 1, tzinfo=UTC), pl.Datetime("us", "UTC"))
    return pl.DataFrame(signals).with_columns(
        pl.lit("A").alias("tail"),
        (start + pl.duration(seconds=pl.int_range(600))).alias("time_utc"),
        pl.lit("cruise").alias("phase"),
        pl.lit(True).alias("level"),
        pl.lit(0.0).alias("climb_rate_m_s"),
        pl.lit(0, pl.Int32).alias("n_spikes"),
    )


def test_average_is_the_mean_of_its_minute():
    averaged = average_log(log({}), by=("tail",))
    assert averaged["n_averaged"].to_list() == [60] * 10
    assert averaged["steady"].all()
    for signal in SIGNALS:
        expected = log({})[signal].to_numpy().reshape(10, 60).mean(axis=1)
        np.testing.assert_allclose(averaged[signal].to_numpy(), expected, rtol=1e-12)


@pytest.mark.parametrize("signal", DRIVERS)
def test_minute_in_which_a_driver_drifts_is_not_steady(signal):
    assert not average_log(log({signal: 4.0 * DRIVERS[signal][0]}), by=("tail",))["steady"].any()


def test_drift_too_slow_to_matter_is_steady():
    slow = {s: 0.2 * rate for s, (rate, _) in DRIVERS.items()}
    assert average_log(log(slow), by=("tail",))["steady"].all()


def test_drivers_on_paper():
    assert DRIVERS == {
        "altitude_m": (1.524, 5.0), "mach": (4.0e-4, 1.5e-3), "tat_k": (0.03, 0.35), "hx_in_k": (0.08, 0.6),
        "pack_flow_kg_s": (1.5e-3, 0.012), "ram_door_open": (2.0e-3, 0.012),
    }  # fmt: skip


def test_windows_speak_for_the_seconds_around_them():
    x = np.random.default_rng(6).normal(size=200)
    t = slope_t(x)
    own = [slope_t(x[k : k + 60])[0] for k in range(141)]
    np.testing.assert_allclose(t, [own[min(max(k - 30, 0), 140)] for k in range(200)], rtol=1e-6, atol=1e-9)
    ramp = np.arange(120.0)
    assert np.isinf(slope_t(ramp)[60]) or slope_t(ramp)[60] > 1e6
    steps = slope_t(np.arange(60.0), resolution=12.0)[0]
    assert steps == pytest.approx(1.0 / np.sqrt(12.0 / (60.0 * (60.0**2 - 1.0) / 12.0)))
    assert (is_transient(x) == (np.abs(t) > 4.0)).all()


@pytest.mark.parametrize(("seconds", "averaged"), [(45, 1), (44, 0)])
def test_a_minute_wants_three_quarters_of_its_seconds(seconds, averaged):
    assert average_log(log({}).head(seconds), by=("tail",)).height == averaged


def test_a_signal_wants_half_of_its_minute():
    at = pl.int_range(pl.len())
    for n, known in ((31, True), (30, False)):
        half = log({}).head(60).with_columns(mach=pl.when(at < n).then("mach"), level=at != 3, n_spikes=pl.lit(2))
        row = average_log(half, by=("tail",)).row(0, named=True)
        assert (row["mach"] is not None) is known
        assert (row["level"], row["n_spikes"], row["n_averaged"]) == (False, 120, 60)


def test_a_slope_is_both_significant_and_harmful():
    """Student's t of the line through ten readings, 4 at most, or a drift below what does harm."""
    second, rng = np.arange(10.0), np.random.default_rng(1)
    noise = rng.normal(size=10)
    noise -= np.polyval(np.polyfit(second, noise, 1), second)
    sd = np.sqrt((noise**2).sum() / 8.0 / ((second - 4.5) ** 2).sum())
    for t, times, free in ((4.05, 1.01, False), (3.95, 1.01, True), (4.05, 0.99, True), (-4.05, 1.01, False)):
        slope = t * sd
        rows = pl.DataFrame({"s": second, "x": noise + slope * second})
        assert rows.select(drift_free(pl.col("s"), "x", abs(slope) / times)).item() is free
    gap = pl.DataFrame({"s": second, "x": [None] * 10}, schema_overrides={"x": pl.Float64})
    assert gap.select(drift_free(pl.col("s"), "x", 1.0)).item() is True


@pytest.mark.parametrize("signal", DRIVERS)
def test_a_snapshot_is_held_where_the_nearer_neighbour_agrees(signal):
    rate, noise = DRIVERS[signal]
    most = max(rate * 60.0, 4.0 * 2.0**0.5 * noise)
    for every_s in (60.9, 600.9):
        most = max(rate * every_s, 4.0 * 2.0**0.5 * noise)
        for times, steady in ((0.999, True), (1.001, False)):
            assert held(signal, [0.0, times * most, 3.0 * most], every_s)[1] is steady
            assert held(signal, [0.0, -times * most, -9.0 * most], every_s)[1] is steady
            assert held(signal, [9.0 * most, 0.0, times * most], every_s)[1] is steady


def held(signal: str, values: list[float], every_s: float, **more: object) -> list[bool]:
    start = datetime(2024, 3, 1, tzinfo=UTC)
    rows = {
        "tail": "A", "time_utc": [start + timedelta(seconds=every_s * k) for k in range(len(values))], "level": True,
        "phase": "cruise",
    }  # fmt: skip
    frame = pl.DataFrame(rows | dict.fromkeys(DRIVERS, 1.0) | {signal: values} | more)
    return steady_snapshots(frame, by=("tail",))["steady"].to_list()


def test_neighbours_of_another_phase_do_not_count_and_a_level_is_needed():
    assert held("mach", [0.0, 0.5], 60, phase=["climb", "cruise"]) == [True, True]
    assert held("mach", [0.0, 0.0], 60, level=[False, True]) == [False, True]
