"""Cross checks of a leg by hand, and a shift just over and just under what is allowed."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from hdt_core.flight.control_schedules import ControlSchedule, has_authority, learn_outlet_schedule
from hdt_core.flight.cross_checks import TOLERANCE, check_sensors, leg_checks
from hdt_core.records.keys import LEG

N = 60
FLIGHT = np.arange(N)


def samples(pack: int, **changed: object) -> pl.DataFrame:
    """Six samples of a leg: two of the climb, four of the cruise."""
    at = [datetime(2024, 3, 1, 6, tzinfo=UTC) + timedelta(minutes=k) for k in range(6)]
    signals = {
        "time_utc": at, "source": "acms", "phase": ["climb"] * 2 + ["cruise"] * 4,
        "altitude_m": [5000.0, 8000.0, 1e4, 1e4, 1.1e4, 1.1e4], "tat_k": [265.0, 258.0, 250.0, 251.0, 248.0, 247.0],
        "total_pressure_pa": 36e3, "hx_out_k": [300.0, 301.0, 302.0, 303.0, 304.0, 305.0],
        "ram_door_open": [0.3, 0.08, 0.95, 0.5, 0.07, 0.96], "pack_flow_kg_s": [0.8, 0.8, 0.82, 0.84, 0.86, 0.2],
        "cc_in_k": 252.0, "cc_in_pa": 35e3, "cc_flow_kg_s": 0.8,
    }  # fmt: skip
    frame = pl.DataFrame(signals | {"operator": "TST", "tail": "T", "flight_id": "F", "pack": pack} | changed)
    return frame.cast({"pack": pl.Int32, "time_utc": pl.Datetime("us", "UTC")})


def test_leg_checks_by_hand():
    """The last sample is at rest (.2 kg/s); doors of .07 and .96 are at their ends."""
    two = samples(2, hx_out_k=[299.0, 299.0, 301.0, 302.0, 303.0, 303.0], ram_door_open=0.4, pack_flow_kg_s=0.75)
    law = ControlSchedule((240.0, 270.0), {"": (296.0, 311.0)}, {"": 0.0})
    row = leg_checks(pl.concat([samples(1), two]), law).row(by_predicate=pl.col("pack") == 1, named=True)
    by_law = [301.0 + 0.5 * (tat_k - 250.0) for tat_k in (265.0, 258.0, 250.0, 251.0)]
    flow = np.log([0.82, 0.84, 0.86])
    expected = {
        "outlet_between_packs_k": np.mean([1.0, 2.0, 1.0, 1.0]),
        "outlet_above_law_k": np.mean([300.0, 301.0, 302.0, 303.0]) - np.mean(by_law),
        "inlet_minus_tat_k": 252.0 - np.mean([265.0, 258.0, 250.0, 251.0, 248.0]),
        "inlet_over_total_pressure_ln": np.log(35.0 / 36.0),
        "pack_over_compressor_flow_ln": np.mean(flow) - np.log(0.8),
        "pack_flow_between_packs_ln": np.mean(flow) - np.log(0.75), "pack_flow_ln": np.mean(flow),
    }  # fmt: skip
    assert {name: row[name] for name in expected} == pytest.approx(expected)


def test_impossible_readings_have_no_check():
    none = leg_checks(samples(1, cc_in_pa=0.0, cc_flow_kg_s=-1.0), None)
    names = ("inlet_over_total_pressure_ln", "pack_over_compressor_flow_ln", "outlet_above_law_k")
    assert none.select(names).row(0) == (None,) * 3


@pytest.mark.parametrize(
    ("door", "flow", "free"),
    [
        (0.08, 0.5, True), (0.079, 0.5, False), (0.95, 0.5, True), (0.951, 0.5, False), (0.5, 0.2, False),
        (0.5, 0.21, True),
    ],
)  # fmt: skip
def test_door_authority_ends_at_stops(door, flow, free):
    rows = pl.DataFrame({"other_ram_door_open": [door], "other_pack_flow_kg_s": [flow]})
    assert rows.select(has_authority("other_")).item() is free


def test_outlet_schedule_uses_free_doors():
    """Of running packs."""
    k = np.arange(60)
    tat = np.random.default_rng(0).uniform(230.0, 310.0, 60)
    rows = pl.DataFrame({
        "tail": "T", "flight_id": "F", "pack": 1, "tat_k": tat, "hx_out_k": 200.0 + 0.4 * tat + 50.0 * (k >= 50),
        "ram_door_open": np.where(k < 55, 0.95, 0.96), "pack_flow_kg_s": np.where(k < 50, 0.21, 0.2),
    })  # fmt: skip
    law = learn_outlet_schedule(rows)
    assert np.diff(law.shape("T", np.array([240.0, 300.0]))) == pytest.approx(24.0, abs=0.01)
    assert law == learn_outlet_schedule(rows.head(50))


def judge(*packs: dict[str, object]) -> pl.DataFrame:
    """Verdicts on sixty flights of packs with these checks."""
    key = {"operator": "TST", "tail": "T", "flight_id": [f"F{k:02d}" for k in range(N)]}
    rows = pl.concat([pl.DataFrame(key | {"pack": n} | p) for n, p in enumerate(packs, 1)], how="diagonal")
    rows = rows.cast({"pack": pl.Int32})
    legs = rows.select(*LEG, flight_number=pl.col("flight_id").str.slice(1).cast(pl.Int64))
    return check_sensors(rows, legs).join(legs, on=LEG).sort("pack", "flight_number")


def test_tolerances_are_as_declared():
    assert TOLERANCE == {
        "outlet_between_packs_k": 1.2, "inlet_minus_tat_k": 0.8, "inlet_over_total_pressure_ln": 0.015,
        "pack_over_compressor_flow_ln": 0.030, "pack_flow_between_packs_ln": 0.045, "inlet_apart_k": 2.5,
        "door_apart_ln": 0.06,
    }  # fmt: skip


LATE = FLIGHT >= 40


@pytest.mark.parametrize("check", TOLERANCE)
@pytest.mark.parametrize(("times", "shifted"), [(1.01, True), (1.0, False), (-1.01, True)])
def test_lasting_shift_exceeds_tolerance(check, times, shifted):
    rows = judge({check: times * TOLERANCE[check] * LATE})
    assert rows["sensor_shift"].to_list() == (LATE & shifted).tolist()
    assert set(rows["sensor_check"]) - {None} == ({check} if shifted else set())


@pytest.mark.parametrize("check", TOLERANCE)
@pytest.mark.parametrize("times", [1.01, 1.0, -1.01])
def test_shift_is_stated_for_its_check(check, times):
    shift = times * TOLERANCE[check] * LATE
    rows = judge({check: shift})
    assert rows[f"{check}_off"].to_list() == pytest.approx(shift.tolist())
    assert rows.select(f"{other}_off" for other in TOLERANCE if other != check).sum_horizontal().to_list() == [0.0] * N


@pytest.mark.parametrize(("times", "shifted"), [(1.01, True), (0.99, False)])
def test_noisy_check_needs_four_deviations(times, shifted):
    """Of the median of seven flights, which is 0; most steps are 2."""
    noise = np.tile([2.0, 0.0, -2.0], N // 3)
    sd_k = 1.2533 * 1.4826 * 2.0 / (2.0 * 7.0) ** 0.5
    flags = judge({"inlet_minus_tat_k": noise + times * 4.0 * sd_k * (FLIGHT >= 50)})["sensor_shift"].to_list()
    assert flags[53:57] == [shifted] * 4
    assert not any(flags[:45])


@pytest.mark.parametrize(("times", "shifted"), [(1.01, True), (0.99, False)])
def test_noisy_flight_needs_four_deviations(times, shifted):
    values = np.where(FLIGHT == 30, times * 4.0 * 1.4826 * 2.0, 2.0 * (-1.0) ** FLIGHT)
    assert judge({"inlet_apart_k": values})["sensor_shift"][30] is shifted


@pytest.mark.parametrize(("times", "shifted"), [(2.51, True), (2.49, False)])
def test_large_shift_needs_one_flight(times, shifted):
    """Two and a half tolerances."""
    rows = judge({"inlet_apart_k": times * 2.5 * (FLIGHT == 30)})
    assert rows["sensor_shift"].to_list() == ((FLIGHT == 30) & shifted).tolist()


def test_drift_is_flagged_from_start():
    """From a quarter of the tolerance of .8 K: .2 K after 2.5 flights."""
    drift = np.clip(FLIGHT - 30, 0, 20) * 0.1 * 0.8
    rows = judge({"inlet_minus_tat_k": np.where(FLIGHT < 50, drift, 0.0)})
    assert rows.filter("sensor_shift")["flight_number"].min() == 33
    assert rows["sensor_shift"][49]


@pytest.mark.parametrize(
    ("of_second", "flagged"),
    [
        ({}, [20, 20]),  # its own reading is not known, so it is not cleared
        ({"outlet_above_law_k": 0.49 * 2.0 * LATE}, [20, 0]), ({"outlet_above_law_k": 0.51 * 2.0 * LATE}, [20, 20]),
    ],
)  # fmt: skip
def test_pack_near_law_is_cleared(of_second, flagged):
    """Two outlets differ: pack 1 is off the fleet's law, pack 2 by a share of that."""
    shift = 2.0 * LATE
    one = {"outlet_between_packs_k": shift, "outlet_above_law_k": shift}
    rows = judge(one, {"outlet_between_packs_k": -shift} | of_second)
    assert [rows.filter(pack=pack)["sensor_shift"].sum() for pack in (1, 2)] == flagged
