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
    two = samples(2, hx_out_k=[299.0, 299.0, 301.0, 302.0, 303.0, 303.0], ram_door_open=0.4, pack_flow_kg_s=0.75)
    law = ControlSchedule((240.0, 270.0), {"": (296.0, 311.0)}, {"": 0.0})
    row = leg_checks(pl.concat([samples(1), two]), law).row(by_predicate=pl.col("pack") == 1, named=True)
    # the last sample is at rest (.2 kg/s); doors of .07 and .96 are at their ends
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
    none = leg_checks(samples(1, cc_in_pa=0.0, cc_flow_kg_s=-1.0), None).row(0, named=True)
    names = ("inlet_over_total_pressure_ln", "pack_over_compressor_flow_ln", "outlet_above_law_k")
    assert [none[c] for c in names] == [None] * 3


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
    rng = np.random.default_rng(0)
    tat = rng.uniform(230.0, 310.0, 60)
    outlet = 200.0 + 0.4 * tat + 50.0 * (np.arange(60) >= 50)
    door, flow = np.where(np.arange(60) < 55, 0.95, 0.96), np.where(np.arange(60) < 50, 0.21, 0.2)
    rows = pl.DataFrame({
        "tail": "T", "flight_id": "F", "pack": 1, "tat_k": tat, "hx_out_k": outlet,
        "ram_door_open": door, "pack_flow_kg_s": flow,
    })  # fmt: skip
    law = learn_outlet_schedule(rows)
    at = np.array([240.0, 300.0])
    assert np.diff(law.shape("T", at)) == pytest.approx(24.0, abs=0.01)
    assert law == learn_outlet_schedule(rows.head(50))


def checked(column: str, values: np.ndarray, other: np.ndarray | None = None, **more: np.ndarray) -> pl.DataFrame:
    """Verdicts on sixty flights of one pack, and of the other where it is given."""
    packs = [{"pack": 1, column: values} | more] + ([] if other is None else [{"pack": 2, column: other}])
    key = {"operator": "TST", "tail": "T", "flight_id": [f"F{k:02d}" for k in range(N)]}
    rows = pl.concat([pl.DataFrame(key | p) for p in packs], how="diagonal").cast({"pack": pl.Int32})
    legs = rows.select(*LEG, flight_number=pl.col("flight_id").str.slice(1).cast(pl.Int64))
    return check_sensors(rows, legs).join(legs, on=LEG).sort("pack", "flight_number")


ALTERNATE = np.where(FLIGHT % 2 == 0, 1.0, -1.0)


def test_tolerances_are_as_declared():
    assert TOLERANCE == {
        "outlet_between_packs_k": 1.2, "inlet_minus_tat_k": 0.8, "inlet_over_total_pressure_ln": 0.015,
        "pack_over_compressor_flow_ln": 0.030, "pack_flow_between_packs_ln": 0.045, "inlet_apart_k": 2.5,
        "door_apart_ln": 0.06,
    }  # fmt: skip


@pytest.mark.parametrize("check", TOLERANCE)
@pytest.mark.parametrize(("times", "shifted"), [(1.01, True), (1.0, False), (-1.01, True)])
def test_lasting_shift_exceeds_tolerance(check, times, shifted):
    late = FLIGHT >= 40
    rows = checked(check, times * TOLERANCE[check] * late)
    assert rows["sensor_shift"].to_list() == (late if shifted else late & False).tolist()
    assert set(rows["sensor_check"]) - {None} == ({check} if shifted else set())
    assert rows[f"{check}_off"].to_list() == pytest.approx((times * TOLERANCE[check] * late).tolist())
    assert rows.select(f"{other}_off" for other in TOLERANCE if other != check).sum_horizontal().to_list() == [0.0] * N


@pytest.mark.parametrize(("times", "shifted"), [(1.01, True), (0.99, False)])
def test_noisy_check_needs_four_deviations(times, shifted):
    noise = np.tile([2.0, 0.0, -2.0], N // 3)  # medians of seven are 0, most steps 2
    sd_k = 1.2533 * 1.4826 * 2.0 / (2.0 * 7.0) ** 0.5
    flags = checked("inlet_minus_tat_k", noise + times * 4.0 * sd_k * (FLIGHT >= 50))["sensor_shift"].to_list()
    assert flags[53:57] == [shifted] * 4
    assert not any(flags[:45])
    values = 2.0 * ALTERNATE
    values[30] = times * 4.0 * 1.4826 * 2.0
    rows = checked("inlet_apart_k", values)
    assert rows["sensor_shift"][30] is shifted


@pytest.mark.parametrize(("times", "shifted"), [(2.51, True), (2.49, False)])
def test_large_shift_needs_one_flight(times, shifted):
    """Two and a half tolerances."""
    rows = checked("inlet_apart_k", times * 2.5 * (FLIGHT == 30))
    assert rows["sensor_shift"].to_list() == ((FLIGHT == 30) & shifted).tolist()


def test_drift_is_flagged_from_start():
    drift = np.clip(FLIGHT - 30, 0, 20) * 0.1 * 0.8
    rows = checked("inlet_minus_tat_k", np.where(FLIGHT < 50, drift, 0.0))
    first = rows.filter("sensor_shift")["flight_number"].min()
    # a quarter of the tolerance of .8 K: .2 K after 2.5 flights
    assert first == 33
    assert rows["sensor_shift"][49]
    late = 2.0 * (FLIGHT >= 40)
    law = {"outlet_above_law_k": late}
    rows = checked("outlet_between_packs_k", late, -late, **law)
    assert rows.filter(pl.col("pack") == 1)["sensor_shift"].sum() == 20
    other = rows.filter(pl.col("pack") == 2)["sensor_shift"].sum()
    assert other == 20  # its own reading is not known, so it is not cleared
    for share, cleared in ((0.49, True), (0.51, False)):
        rows = two_packs(late, share)
        assert (rows.filter(pl.col("pack") == 2)["sensor_shift"].sum() == 0) is cleared
        assert rows.filter(pl.col("pack") == 1)["sensor_shift"].sum() == 20


def two_packs(late: np.ndarray, share: float) -> pl.DataFrame:
    """Pack 1 reads high; pack 2 is displaced from the law by a share of that."""
    key = {"operator": "TST", "tail": "T", "flight_id": [f"F{k:02d}" for k in range(N)]}
    one = pl.DataFrame(key | {"pack": 1, "outlet_between_packs_k": late, "outlet_above_law_k": late})
    two = pl.DataFrame(key | {"pack": 2, "outlet_between_packs_k": -late, "outlet_above_law_k": share * late})
    rows = pl.concat([one, two]).cast({"pack": pl.Int32})
    legs = rows.select(*LEG, flight_number=pl.col("flight_id").str.slice(1).cast(pl.Int64))
    return check_sensors(rows, legs).join(legs, on=LEG).sort("pack", "flight_number")
