"""Phases of a real flight against openap's, of thinned and of awkward flights."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from hdt_core.flight.phases import add_phases

A320 = Path(__file__).parents[2] / "data" / "flight_a320" / "altitude_1hz.parquet"
TOP_OF_CLIMB_S = 1799
TOP_OF_DESCENT_S = 10379
DESCENT_ENDS_S = 11759
"""By openap's FlightPhase."""
BY = ("tail",)


def record(altitude_m: np.ndarray, every_s: float = 1.0, **more: np.ndarray) -> pl.DataFrame:
    second = pl.duration(seconds=pl.int_range(altitude_m.size) * every_s)
    start = pl.lit(datetime(2024, 3, 1, tzinfo=UTC), pl.Datetime("us", "UTC"))
    signals = {"altitude_m": np.asarray(altitude_m, float), **more}
    return pl.DataFrame(signals).with_columns(pl.lit("A").alias("tail"), (start + second).alias("time_utc"))


@pytest.fixture(scope="module")
def a320() -> np.ndarray:
    return 0.3048 * pl.read_parquet(A320)["altitude_ft"].to_numpy()


def openap_phases(second: np.ndarray) -> np.ndarray:
    return np.where(second < TOP_OF_CLIMB_S, "climb", np.where(second < TOP_OF_DESCENT_S, "cruise", "descent"))


def phases_of(rows: pl.DataFrame) -> np.ndarray:
    return add_phases(rows, by=BY)["phase"].to_numpy()


def test_real_flight_agrees_with_openap(a320):
    phase = phases_of(record(a320))
    second = np.arange(phase.size)
    cruise = np.flatnonzero(phase == "cruise")
    assert (phase == openap_phases(second))[second < DESCENT_ENDS_S].mean() >= 0.97
    assert abs(cruise[0] - TOP_OF_CLIMB_S) <= 90
    assert abs(cruise[-1] + 1 - TOP_OF_DESCENT_S) <= 90


def test_missing_altitudes_keep_cruise(a320):
    holed = np.where(np.random.default_rng(2).random(a320.size) < 0.05, np.nan, a320)
    phase = phases_of(record(holed).with_columns(pl.col("altitude_m").fill_nan(None)))
    assert (phase[TOP_OF_CLIMB_S + 90 : TOP_OF_DESCENT_S - 90] == "cruise").all()


def test_recorders_phase_code_is_ignored(a320):
    wrong = record(a320, phase_code=np.full(a320.size, "GR"))
    assert (phases_of(wrong) == phases_of(record(a320))).all()


@pytest.mark.parametrize("every_s", [120, 240, 420])
def test_snapshots_have_same_phases(a320, every_s):
    phase = phases_of(record(a320[::every_s], every_s))
    second = np.arange(phase.size) * every_s
    clear = np.minimum(abs(second - TOP_OF_CLIMB_S), abs(second - TOP_OF_DESCENT_S)) > every_s
    assert (phase == openap_phases(second))[clear].all()


@pytest.mark.parametrize("every_s", [1, 150])
def test_manoeuvres_have_no_cruise(every_s):
    second = np.arange(0, 5400, every_s)
    weave = 6000.0 + 1500.0 * np.sin(2 * np.pi * second / 700.0)
    envelope = np.clip(np.minimum(second, 5400 - second) / 600.0, 0.0, 1.0)
    assert "cruise" not in phases_of(record(weave * envelope, every_s))


def test_low_hold_is_no_cruise():
    legs = (
        ("climb", np.arange(0, 10_000, 10.0)), ("cruise", np.full(1500, 10_000.0)),
        ("climb", np.arange(10_000, 10_600, 4.0)), ("cruise", np.full(1500, 10_600.0)),
        ("descent", np.arange(10_600, 2_400, -8.0)), ("descent", np.full(900, 2_400.0)),
        ("descent", np.arange(2_400, 0, -6.0)),
    )  # fmt: skip
    phase = phases_of(record(np.concatenate([altitude for _, altitude in legs])))
    ends = np.cumsum([altitude.size for _, altitude in legs])
    middle = (np.concatenate([[0], ends[:-1]]) + ends) // 2
    assert list(phase[middle]) == [name for name, _ in legs]


def test_low_mach_is_ground():
    altitude = np.concatenate([np.full(300, 100.0), np.arange(100, 9_000, 10.0), np.full(1200, 9_000.0)])
    mach = np.where(np.arange(altitude.size) < 300, 0.02, 0.6)
    phase = phases_of(record(altitude, mach=mach))
    assert set(phase[:250]) == {"ground"}
    assert phase[-100] == "cruise"


def phases(altitude_m: list[float], every_s: float = 120.0, **more: np.ndarray) -> list[str]:
    return phases_of(record(np.array(altitude_m), every_s, **more)).tolist()


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
    phases = add_phases(record(np.array([8e3, 8e3 + step_m]), every_s), by=BY)
    assert phases["level"].to_list() == [level] * 2
    assert phases["climb_rate_m_s"].to_list() == pytest.approx([step_m / every_s] * 2)


@pytest.mark.parametrize(("rate", "level"), [(1.52, True), (1.53, False)])
def test_level_log_climbs_slowly(rate, level):
    """Below 300 ft a minute."""
    phases = add_phases(record(8e3 + rate * np.arange(200.0)), by=BY)
    assert phases["level"].to_list() == [level] * 200


def test_log_climb_rate_spans_a_minute():
    bump = np.where(np.arange(200) < 100, 8e3, 8060.0)
    rates = add_phases(record(bump), by=BY)["climb_rate_m_s"]
    assert rates.gather([69, 70, 129, 130]).to_list() == pytest.approx([0.0, 1.0, 1.0, 0.0])


@pytest.mark.parametrize(("every_s", "continuous"), [(10.0, True), (10.5, False)])
def test_ten_second_records_are_log(every_s, continuous):
    # sixty samples of a log are smoothed over thirty on either side, snapshots are not
    bump = np.where(np.arange(100) == 50, 8100.0, 8e3)
    level = add_phases(record(bump, every_s), by=BY)["level"].to_list()
    assert level[50] is continuous


FLIGHT_M = [100.0, 100.0, 100.0, 5e3, 9e3, 9e3, 9e3, 9e3, 4e3, 50.0, 50.0]


def test_ground_is_at_either_end():
    phase = phases(FLIGHT_M)
    assert phase[:3] + phase[-2:] == ["ground"] * 5


@pytest.mark.parametrize(("mach", "ground"), [(0.149, True), (0.15, False)])
def test_ground_is_below_mach_limit(mach, ground):
    assert (phases(FLIGHT_M, mach=np.full(11, mach))[5] == "ground") is ground


@pytest.mark.parametrize(("first_m", "phase"), [(5500.0, "cruise"), (5300.0, "climb")])
def test_record_may_begin_in_cruise(first_m, phase):
    assert phases([first_m, 5500.0, 5500.0, 9e3, 9e3, 9e3, 9e3])[0] == phase


def test_high_level_is_no_ground():
    off = phases([2e3, 4e3, 4e3, 9e3, 9e3, 9e3, 9e3, 4e3, 4e3, 0.0])
    assert (off[1], off[8]) == ("climb", "descent")
