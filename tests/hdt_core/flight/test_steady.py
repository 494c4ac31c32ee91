"""The slope test finds planted ramps, and averages of a log are what they say."""

from datetime import UTC, datetime

import numpy as np
import polars as pl
import pytest

from hdt_core.flight.quality import SIGNALS
from hdt_core.flight.steady import DRIVERS, WINDOW_S, average_log, is_transient, slope_t

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
