"""Phases of a real flight against openap's, of thinned and of awkward flights."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from hdt_core.flight.samples import add_phases

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
    compared = second < DESCENT_ENDS_S
    assert (phase == openap)[compared].mean() >= 0.97
    cruise = np.flatnonzero(phase == "cruise")
    assert abs(cruise[0] - TOP_OF_CLIMB_S) <= 90
    assert abs(cruise[-1] + 1 - TOP_OF_DESCENT_S) <= 90
    holed = a320.copy()
    holed[np.random.default_rng(2).random(holed.size) < 0.05] = np.nan
    frame = flown(holed).with_columns(pl.col("altitude_m").fill_nan(None))
    phase = add_phases(frame, by=BY)["phase"].to_numpy()
    assert (phase[TOP_OF_CLIMB_S + 90 : TOP_OF_DESCENT_S - 90] == "cruise").all()
    wrong = flown(a320, phase_code=np.full(a320.size, "GR"))
    assert add_phases(wrong, by=BY)["phase"].equals(add_phases(flown(a320), by=BY)["phase"])


@pytest.mark.parametrize("every_s", [120, 240, 420])
def test_snapshots_have_same_phases(a320, every_s):
    thinned = flown(a320[::every_s], every_s)
    phase = add_phases(thinned, by=BY)["phase"].to_numpy()
    second = np.arange(phase.size) * every_s
    clear = np.minimum(abs(second - TOP_OF_CLIMB_S), abs(second - TOP_OF_DESCENT_S)) > every_s
    openap = np.where(second < TOP_OF_CLIMB_S, "climb", np.where(second < TOP_OF_DESCENT_S, "cruise", "descent"))
    assert (phase == openap)[clear].all()


@pytest.mark.parametrize("every_s", [1, 150])
def test_manoeuvres_have_no_cruise(every_s):
    second = np.arange(0, 5400, every_s)
    weave = 6000.0 + 1500.0 * np.sin(2 * np.pi * second / 700.0)
    envelope = np.clip(np.minimum(second, 5400 - second) / 600.0, 0.0, 1.0)
    assert "cruise" not in set(add_phases(flown(weave * envelope, every_s), by=BY)["phase"])


def test_low_hold_is_no_cruise():
    up, down = np.arange(0, 10_000, 10.0), np.arange(10_600, 2_400, -8.0)
    level, step, high = np.full(1500, 10_000.0), np.arange(10_000, 10_600, 4.0), np.full(1500, 10_600.0)
    hold, land = np.full(900, 2_400.0), np.arange(2_400, 0, -6.0)
    whole = np.concatenate([up, level, step, high, down, hold, land])
    phase = add_phases(flown(whole), by=BY)["phase"].to_numpy()
    ends = np.cumsum([p.size for p in (up, level, step, high, down, hold, land)])
    middle = (np.concatenate([[0], ends[:-1]]) + ends) // 2
    assert list(phase[middle]) == ["climb", "cruise", "climb", "cruise", "descent", "descent", "descent"]
    altitude = np.concatenate([np.full(300, 100.0), np.arange(100, 9_000, 10.0), np.full(1200, 9_000.0)])
    mach = np.concatenate([np.full(300, 0.02), np.full(altitude.size - 300, 0.6)])
    phase = add_phases(flown(altitude, mach=mach), by=BY)["phase"].to_numpy()
    assert set(phase[:250]) == {"ground"}
    assert phase[-100] == "cruise"


def phases(altitude_m: list[float], every_s: float = 120.0, **more: np.ndarray) -> list[str]:
    return add_phases(flown(np.array(altitude_m), every_s, **more), by=BY)["phase"].to_list()


@pytest.mark.parametrize(
    ("level_m", "top_m", "cruise"),
    [(4573.0, 4573.0, 1), (4572.0, 4572.0, 0), (6001.0, 1e4, 1), (6000.0, 1e4, 0)],
)
def test_cruise_floor(level_m, top_m, cruise):
    """15,000 ft and six tenths of the top."""
    flight = [0.0, *[level_m] * 4, *([top_m] * 4 if top_m > level_m else []), 0.0]
    assert (phases(flight)[2] == "cruise") == cruise


@pytest.mark.parametrize(("every_s", "cruise"), [(150.0, True), (149.0, False)])
def test_five_level_minutes_are_cruise(every_s, cruise):
    assert (phases([0.0, 8e3, 8e3, 8e3, 0.0], every_s)[2] == "cruise") is cruise


@pytest.mark.parametrize(
    ("step_m", "every_s", "level"), [(30.4, 120.0, True), (30.5, 120.0, False), (30.0, 19.7, True), (30.0, 19.6, False)]
)
def test_level_snapshots_climb_slowly(step_m, every_s, level):
    """Within 100 ft, or 300 ft a minute."""
    phases = add_phases(flown(np.array([8e3, 8e3 + step_m]), every_s), by=BY)
    assert phases["level"].to_list() == [level] * 2
    assert phases["climb_rate_m_s"].to_list() == pytest.approx([step_m / every_s] * 2)


@pytest.mark.parametrize(("rate", "level"), [(1.52, True), (1.53, False)])
def test_level_log_climbs_slowly(rate, level):
    phases = add_phases(flown(8e3 + rate * np.arange(200.0)), by=BY)
    assert phases["level"].to_list() == [level] * 200
    bump = np.where(np.arange(200) < 100, 8e3, 8060.0)
    rates = add_phases(flown(bump), by=BY)["climb_rate_m_s"].to_list()
    assert rates[69:71] == pytest.approx([0.0, 1.0])
    assert rates[129:131] == pytest.approx([1.0, 0.0])


@pytest.mark.parametrize(("every_s", "continuous"), [(10.0, True), (10.5, False)])
def test_ten_second_records_are_log(every_s, continuous):
    # sixty samples of a log are smoothed over thirty on either side, snapshots are not
    bump = np.where(np.arange(100) == 50, 8100.0, 8e3)
    level = add_phases(flown(bump, every_s), by=BY)["level"].to_list()
    assert level[50] is continuous


def test_ground_is_far_below_top():
    flight = [100.0, 100.0, 100.0, 5e3, 9e3, 9e3, 9e3, 9e3, 4e3, 50.0, 50.0]
    assert phases(flight)[:3] == ["ground"] * 3
    assert phases(flight)[-2:] == ["ground"] * 2
    for mach, ground in ((0.149, True), (0.15, False)):
        assert (phases(flight, mach=np.full(11, mach))[5] == "ground") is ground
    high = [5500.0, 5500.0, 5500.0, 9e3, 9e3, 9e3, 9e3]
    assert phases(high)[0] == "cruise"
    assert phases([5300.0, *high[1:]])[0] == "climb"
    off = [2e3, 4e3, 4e3, 9e3, 9e3, 9e3, 9e3, 4e3, 4e3, 0.0]
    assert [phases(off)[k] for k in (1, 8)] == ["climb", "descent"]
