"""Averages of a log, the slope test of its minutes, and steady snapshots."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from hdt_core.flight.quality import SIGNALS
from hdt_core.flight.steady import DRIVERS, average_log, drift_free, steady_snapshots


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


@pytest.mark.parametrize(("seconds", "averaged"), [(45, 1), (44, 0)])
def test_a_minute_wants_three_quarters_of_its_seconds(seconds, averaged):
    assert average_log(log({}).head(seconds), by=("tail",)).height == averaged


def test_a_signal_wants_half_of_its_minute():
    at = pl.int_range(pl.len())
    for n, has_value in ((31, True), (30, False)):
        half = log({}).head(60).with_columns(mach=pl.when(at < n).then("mach"), level=at != 3, n_spikes=pl.lit(2))
        row = average_log(half, by=("tail",)).row(0, named=True)
        assert (row["mach"] is not None) is has_value
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
            assert frozen_flags(signal, [0.0, times * most, 3.0 * most], every_s)[1] is steady
            assert frozen_flags(signal, [0.0, -times * most, -9.0 * most], every_s)[1] is steady
            assert frozen_flags(signal, [9.0 * most, 0.0, times * most], every_s)[1] is steady


def frozen_flags(signal: str, values: list[float], every_s: float, **more: object) -> list[bool]:
    start = datetime(2024, 3, 1, tzinfo=UTC)
    rows = {
        "tail": "A", "time_utc": [start + timedelta(seconds=every_s * k) for k in range(len(values))], "level": True,
        "phase": "cruise",
    }  # fmt: skip
    frame = pl.DataFrame(rows | dict.fromkeys(DRIVERS, 1.0) | {signal: values} | more)
    return steady_snapshots(frame, by=("tail",))["steady"].to_list()


def test_neighbours_of_another_phase_do_not_count_and_a_level_is_needed():
    assert frozen_flags("mach", [0.0, 0.5], 60, phase=["climb", "cruise"]) == [True, True]
    assert frozen_flags("mach", [0.0, 0.0], 60, level=[False, True]) == [False, True]
