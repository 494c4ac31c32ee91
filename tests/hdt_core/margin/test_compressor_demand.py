"""The flow a compressor can still deliver: equations (2) to (6) at its highest speed, turned round."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from made import departure

from hdt_core.calibration.compressor_fit import CompressorFit
from hdt_core.margin.compressor_demand import (
    CLEAN_PARTS,
    CRITICAL_DIAMETER,
    FLOWS,
    compressor_demand,
    needed,
    share_left,
)
from hdt_core.margin.control_schedules import ALTITUDE_KNOTS_M, ControlSchedule, ControlSchedules
from hdt_core.margin.margin import compressor_margin
from hdt_core.margin.speed_limit import SpeedLimit, speed_limit
from hdt_core.physics.compressor import inlet_flow_kg_s, pressure_ratio

LIMIT_RAD_S = 4500.0
FIT = CompressorFit(
    0.175, 0.001, -2.8e-5, 1e-6, 0.005, 0.004, 0.2, 9.4e-4, 1e-5, 0.74, 0.01, 430.0, 900,
    group_slope_m3_per_count=3.2e-7, group_slope_sd_m3_per_count=1e-8, vda_widest_counts=850.0,
)  # fmt: skip
"""Of the size of the sample's."""
CRUISE = {"flow_kg_s": 0.78, "inlet_k": 252.0, "inlet_pa": 27_500.0, "no_flow_ln": np.log(84_000.0), "flow_ln": 0.1}


def asked(**changed: float) -> pl.DataFrame:
    return pl.DataFrame({name: [value] for name, value in (CRUISE | changed).items()})


def share(ln_diameter: float = 0.0, speed_rad_s: float = LIMIT_RAD_S, **changed: float) -> float:
    found, _ = share_left(np.array([ln_diameter]), *needed(asked(**changed), FIT, speed_rad_s))
    return float(found[0])


def test_at_its_critical_diameter_a_machine_gives_that_flow_at_the_pressure_asked_for():
    critical, _ = needed(asked(), FIT, LIMIT_RAD_S)
    speed = np.array(LIMIT_RAD_S)
    for part, ln_diameter in zip(FLOWS, critical[0], strict=True):
        # forward again: the position that lets the flow through, and the pressure the machine makes there
        flow = part * CRUISE["flow_kg_s"]
        full = inlet_flow_kg_s(np.array(1.0), np.array(CRUISE["inlet_pa"]), np.array(CRUISE["inlet_k"]), speed)
        position = FIT.position_counts(np.array(flow / full))
        np.testing.assert_allclose(FIT.group_at_m3(position) * full, flow, rtol=1e-12)
        diameter = np.exp(ln_diameter) * FIT.diameter_m(position)
        exit_pa = CRUISE["inlet_pa"] * pressure_ratio(diameter, np.array(CRUISE["inlet_k"]), speed)
        asked_pa = np.exp(CRUISE["no_flow_ln"] + CRUISE["flow_ln"] * part**2)
        np.testing.assert_allclose(exit_pa, asked_pa, rtol=1e-12)


def test_a_smaller_machine_delivers_less():
    left = [share(ln_diameter) for ln_diameter in (0.0, -0.03, -0.06, -0.1)]
    assert (np.diff(left) < 0.0).all()
    assert left[-1] > 0.0


@pytest.mark.parametrize(
    "changed", [{"inlet_k": 262.0}, {"inlet_pa": 26_500.0}, {"no_flow_ln": np.log(88_000.0)}, {"flow_kg_s": 0.85}]
)
def test_hotter_thinner_air_more_pressure_and_more_flow_leave_less(changed):
    assert share(-0.05, **changed) < share(-0.05)


def test_a_higher_limit_leaves_more():
    assert share(-0.05, speed_rad_s=1.02 * LIMIT_RAD_S) > share(-0.05)


def test_no_more_is_promised_than_the_widest_position_on_record_lets_through():
    easy = {"inlet_pa": 60_000.0}
    critical, widest = needed(asked(**easy), FIT, LIMIT_RAD_S)
    found, slope = share_left(np.zeros(1), critical, widest)
    assert found[0] == widest[0]
    assert np.isnan(slope[0])
    wider = replace(FIT, vda_widest_counts=900.0)
    assert share_left(np.zeros(1), *needed(asked(**easy), wider, LIMIT_RAD_S))[0][0] > found[0]


def laws(met: bool = True) -> ControlSchedules:
    """Exit pressure all but level with altitude, the flow's share as the sample's."""
    shape = {"": tuple(-1e-5 * (h - 11_000.0) for h in ALTITUDE_KNOTS_M)}
    delivery = ControlSchedule(ALTITUDE_KNOTS_M, shape, {"": 0.17}, {"": float(np.log(86_000.0))})
    return ControlSchedules(
        ControlSchedule((250.0, 300.0), {"": (0.0, 0.0)}, {"": 0.0}), delivery, SpeedLimit(LIMIT_RAD_S, met)
    )


@pytest.fixture(scope="module")
def told(cruise_model, cruise_samples) -> pl.DataFrame:
    """Margin of a machine that has lost four per cent of its diameter from the tenth flight on."""
    asks = compressor_demand(cruise_samples, cruise_model, laws())
    lost = pl.when(pl.int_range(pl.len()) >= 10).then(0.04).otherwise(0.0)
    wide = asks.select("operator", "tail", "pack", "flight_id").with_columns(
        cc_diameter_loss=lost, cc_diameter_loss_sd=pl.lit(0.005), diameter_m=0.16 * (1.0 - lost),
        expected_diameter_m=pl.lit(0.16), cc_life=pl.lit(0),
    )  # fmt: skip
    return compressor_margin(wide, asks)


@pytest.fixture(scope="module")
def cruise_model():
    from made import made_fleet

    from hdt_core.calibration.calibrate import calibrate

    fleet = made_fleet(1, 20)
    return replace(calibrate(fleet.samples, fleet.legs, fleet.maintenance), compressor=FIT)


@pytest.fixture(scope="module")
def cruise_samples() -> pl.DataFrame:
    """Twenty cruises of one pack, at 12,000 m in the main."""
    rows = [
        {
            "operator": "TST", "tail": "T-00", "pack": 1, "flight_id": f"T-00_{k:03d}", "time_utc": departure(k),
            "phase": "cruise", "monitored": True, "altitude_m": 11_600.0 + 100.0 * j, "mach": 0.84, "tat_k": 248.0 + j,
            "total_pressure_pa": 29_500.0 - 300.0 * j, "cc_in_k": 249.0 + j, "cc_in_pa": 29_000.0 - 300.0 * j,
            "cc_out_pa": 95_000.0, "cc_out_k": 380.0, "cc_speed_rad_s": 4150.0, "cc_flow_kg_s": 0.78,
            "vda_counts": 400.0 + 20.0 * j, "pack_flow_kg_s": 0.76, "hx_in_k": 400.0, "hx_out_k": 300.0,
            "ram_door_open": 0.3,
        }
        for k in range(20) for j in range(8)
    ]  # fmt: skip
    return pl.DataFrame(rows).with_columns(
        pl.col("pack").cast(pl.Int32), pl.col("time_utc").cast(pl.Datetime("us", "UTC"))
    )


def test_lost_diameter_is_taken_off_what_is_left(told):
    left = told["cc_diameter_left"].to_numpy()
    np.testing.assert_allclose((1.0 - left[10:]) / (1.0 - left[:10]), 1.0 / 0.96, rtol=1e-9)
    assert (told["cc_diameter_left_sd"] > 0.004).all()
    # forty-one thousand feet and fifteen kelvin are harder than the flight's own cruise
    assert (told["cc_diameter_left_hot_high"] < told["cc_diameter_left"]).all()


def test_the_parts_make_the_margin(told):
    parts = told.select(pl.sum_horizontal(*CLEAN_PARTS, "cc_flow_margin_wear_kg_s", "cc_flow_margin_profile_kg_s"))
    np.testing.assert_allclose(parts[:, 0], told["cc_flow_margin_kg_s"], atol=1e-12)
    assert (told["cc_flow_margin_wear_kg_s"][10:] < -0.01).all()
    assert (told["cc_flow_margin_profile_kg_s"][:10] < 0.0).all()


def test_a_limit_that_was_never_met_and_a_machine_without_a_map_are_said_so(cruise_model, cruise_samples, told):
    asks = compressor_demand(cruise_samples, cruise_model, laws(met=False))
    wide = told.select("operator", "tail", "pack", "flight_id").with_columns(
        cc_diameter_loss=pl.lit(0.04), cc_diameter_loss_sd=pl.lit(0.005), diameter_m=pl.lit(0.15),
        expected_diameter_m=pl.lit(0.16), cc_life=pl.lit(0),
    )  # fmt: skip
    assert set(compressor_margin(wide, asks)["cc_flow_margin_status"]) == {"at_least"}
    assert set(told["cc_flow_margin_status"][10:]) == {"ok"}
    for unsure in ({"group_slope_m3_per_count": 1e-9}, {"group_slope_sd_m3_per_count": 1e-7}):
        blind = replace(cruise_model, compressor=replace(FIT, **unsure))
        nothing = compressor_demand(cruise_samples, blind, laws())
        assert nothing.height == 0
    unknown = compressor_margin(wide, nothing)
    assert set(unknown["cc_flow_margin_status"]) == {"not_known"}
    assert unknown["cc_flow_margin_kg_s"].null_count() == unknown.height


def test_one_sample_without_a_reading_costs_its_flight_nothing(cruise_model, cruise_samples):
    gap = pl.int_range(pl.len()).over("flight_id") == 0
    holed = cruise_samples.with_columns(vda_counts=pl.when(~gap).then("vda_counts"))
    asks = compressor_demand(holed, cruise_model, laws())
    assert asks.height == 20
    assert asks.select(CRITICAL_DIAMETER["p20"]).null_count().sum_horizontal().item() == 0


@pytest.mark.parametrize("name", ["cc_in_pa", "cc_in_k", "vda_counts", "total_pressure_pa", "pack_flow_kg_s"])
def test_readings_that_cannot_be_cost_no_other_flight(cruise_model, cruise_samples, name):
    first = pl.col("flight_id") == "T-00_000"
    clean = compressor_demand(cruise_samples, cruise_model, laws()).filter(~first)
    for value in (0.0, -5000.0, 1e9):
        odd = cruise_samples.with_columns(pl.when(first).then(value).otherwise(name).alias(name))
        told = compressor_demand(odd, cruise_model, laws())
        assert told.filter(~first).equals(clean)
        numbers = told.select(pl.selectors.float())
        assert numbers.select(pl.all().is_finite().fill_null(True).all()).row(0) == (True,) * numbers.width


def flown(rng: np.random.Generator, limit_rad_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Speeds held below a limit, read with their noise, and how far the pressure is beyond its schedule."""
    needed_rad_s = 3500.0 + 330.0 * rng.standard_normal(40_000)
    held = np.minimum(needed_rad_s, limit_rad_s)
    beyond = 2.0 * np.log(held / needed_rad_s) + 0.004 * rng.standard_normal(held.size)
    return held * (1.0 + 0.001 * rng.standard_normal(held.size)), beyond


def test_the_speed_limit_is_found_where_the_pressure_falls_short():
    for seed in range(5):
        found = speed_limit(*flown(np.random.default_rng(seed), 4400.0))
        assert found.met
        assert found.rad_s == pytest.approx(4400.0, rel=0.002)


def test_machines_that_were_never_at_their_limit_show_none():
    for seed in range(5):
        speed, beyond = flown(np.random.default_rng(seed), 9000.0)
        found = speed_limit(speed, beyond)
        assert not found.met
        assert found.rad_s == pytest.approx(np.sort(speed)[-11])
    assert speed_limit(np.full(8, np.nan), np.zeros(8)) == SpeedLimit()


def test_a_spike_of_the_speeds_sensor_is_no_limit():
    speed, beyond = flown(np.random.default_rng(1), 4400.0)
    speed[:10] = 6000.0
    assert speed_limit(speed, beyond).rad_s == pytest.approx(4400.0, rel=0.002)
