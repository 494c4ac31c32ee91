"""Phases of a real flight against openap's, of thinned and of awkward flights."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from hdt_core.flight.phases import add_phases

A320 = Path(__file__).parents[2] / "data" / "flight_a320" / "altitude_1hz.parquet"
TOP_OF_CLIMB_S, TOP_OF_DESCENT_S, DESCENT_ENDS_S = 1799, 10379, 11759  # openap's FlightPhase
BY = ("tail",)


def flown(altitude_m: np.ndarray, every_s: float = 1.0, **more: np.ndarray) -> pl.DataFrame:
    second = pl.duration(seconds=pl.int_range(altitude_m.size) * every_s)
    start = pl.lit(datetime(2024, 3, 1, tzinfo=UTC), pl.Datetime("us", "UTC"))
    signals = {"altitude_m": np.asarray(altitude_m, float), **more}
    return pl.DataFrame(signals).with_columns(pl.lit("A").alias("tail"), (start + second).alias("time_utc"))


@pytest.fixture(scope="module")
def a320() -> np.ndarray:
    return 0.3048 * pl.read_parquet(A320)["altitude_ft"].to_numpy()


def test_real_flight_agrees_with_openap(a320):
    phase = add_phases(flown(a320), by=BY)["phase"].to_numpy()
    second = np.arange(phase.size)
    openap = np.where(second < TOP_OF_CLIMB_S, "climb", np.where(second < TOP_OF_DESCENT_S, "cruise", "descent"))
    known = second < DESCENT_ENDS_S
    assert (phase == openap)[known].mean() >= 0.97
    cruise = np.flatnonzero(phase == "cruise")
    assert abs(cruise[0] - TOP_OF_CLIMB_S) <= 90
    assert abs(cruise[-1] + 1 - TOP_OF_DESCENT_S) <= 90


@pytest.mark.parametrize("every_s", [120, 240, 420])
def test_snapshots_of_the_real_flight_fall_into_the_same_phases(a320, every_s):
    thinned = flown(a320[::every_s], every_s)
    phase = add_phases(thinned, by=BY)["phase"].to_numpy()
    second = np.arange(phase.size) * every_s
    clear = np.minimum(abs(second - TOP_OF_CLIMB_S), abs(second - TOP_OF_DESCENT_S)) > every_s
    openap = np.where(second < TOP_OF_CLIMB_S, "climb", np.where(second < TOP_OF_DESCENT_S, "cruise", "descent"))
    assert (phase == openap)[clear].all()


def test_missing_altitudes_change_nothing_in_cruise(a320):
    holed = a320.copy()
    holed[np.random.default_rng(2).random(holed.size) < 0.05] = np.nan
    frame = flown(holed).with_columns(pl.col("altitude_m").fill_nan(None))
    phase = add_phases(frame, by=BY)["phase"].to_numpy()
    assert (phase[TOP_OF_CLIMB_S + 90 : TOP_OF_DESCENT_S - 90] == "cruise").all()


@pytest.mark.parametrize("every_s", [1, 150])
def test_flight_of_manoeuvres_has_no_cruise(every_s):
    second = np.arange(0, 5400, every_s)
    weave = 6000.0 + 1500.0 * np.sin(2 * np.pi * second / 700.0)
    envelope = np.clip(np.minimum(second, 5400 - second) / 600.0, 0.0, 1.0)
    assert "cruise" not in set(add_phases(flown(weave * envelope, every_s), by=BY)["phase"])


def test_hold_below_the_floor_is_no_cruise_and_step_climb_is_none():
    up, down = np.arange(0, 10_000, 10.0), np.arange(10_600, 2_400, -8.0)
    level, step, high = np.full(1500, 10_000.0), np.arange(10_000, 10_600, 4.0), np.full(1500, 10_600.0)
    hold, land = np.full(900, 2_400.0), np.arange(2_400, 0, -6.0)
    whole = np.concatenate([up, level, step, high, down, hold, land])
    phase = add_phases(flown(whole), by=BY)["phase"].to_numpy()
    ends = np.cumsum([p.size for p in (up, level, step, high, down, hold, land)])
    middle = (np.concatenate([[0], ends[:-1]]) + ends) // 2
    assert list(phase[middle]) == ["climb", "cruise", "climb", "cruise", "descent", "descent", "descent"]


def test_mach_tells_the_ground():
    altitude = np.concatenate([np.full(300, 100.0), np.arange(100, 9_000, 10.0), np.full(1200, 9_000.0)])
    mach = np.concatenate([np.full(300, 0.02), np.full(altitude.size - 300, 0.6)])
    phase = add_phases(flown(altitude, mach=mach), by=BY)["phase"].to_numpy()
    assert set(phase[:250]) == {"ground"}
    assert phase[-100] == "cruise"


def test_recorder_phase_code_is_not_read(a320):
    wrong = flown(a320, phase_code=np.full(a320.size, "GR"))
    assert add_phases(wrong, by=BY)["phase"].equals(add_phases(flown(a320), by=BY)["phase"])
