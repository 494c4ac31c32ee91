"""Ram flow by its laws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdt_core.physics.air import R_J_KG_K, standard_pressure_pa, total_to_static_pressure
from hdt_core.physics.installed_exchanger import (
    DESIGN,
    RAM_DUCT,
    clean_ram_flow_kg_s,
    compressible_flow_kg_s,
    door_area_m2,
    series_area_m2,
    static_pressure_pa,
)

shares = st.floats(0.0, 1.0)


def cruise(**change):
    static_pa = float(standard_pressure_pa(11887.0))
    total_pa = static_pa * float(total_to_static_pressure(0.85))
    inputs = {"ram_door_open": 0.3, "total_pressure_pa": total_pa, "tat_k": 248.0, "altitude_m": 11887.0, "mach": 0.85}
    return inputs | change


DOOR = np.linspace(0.0, 1.0, 101)


@given(shares, shares)
def test_flow_rises_with_door(low, high):
    flow = RAM_DUCT.predict({"ram_door_low": low, "ram_door_high": high}, cruise(ram_door_open=DOOR))["ram_flow_kg_s"]
    assert np.all(np.diff(flow) >= -1e-12)


@given(shares, shares)
def test_door_area_has_declared_ends(low, high):
    area = door_area_m2(DOOR, 0.004, 0.05, low, high)
    assert area[0] == 0.004
    assert area[-1] == pytest.approx(0.05, rel=1e-14)


def test_straight_door_is_linear():
    np.testing.assert_allclose(door_area_m2(DOOR, 0.01, 0.03, 1 / 3, 0.5), 0.01 + 0.02 * DOOR, rtol=1e-14)


def test_door_beyond_its_ends_is_clipped():
    design = np.array([[p.nominal] for p in DESIGN])
    flows = clean_ram_flow_kg_s(cruise(ram_door_open=np.array([-0.02, 0.0, 1.0, 1.02])), design)
    assert flows[0] == flows[1] < flows[2] == flows[3]


@given(st.floats(0.005, 0.3), st.floats(0.005, 0.3))
def test_series_passes_less_than_either(first, second):
    together = series_area_m2(first, second)
    assert together < min(first, second)
    assert series_area_m2(first, first) == pytest.approx(first / np.sqrt(2.0))


def test_throat_passes_density_times_velocity():
    total_pa = 60e3
    exit_pa = 45e3
    total_k = 270.0
    throat_k = total_k * (exit_pa / total_pa) ** (0.4 / 1.4)
    velocity = np.sqrt(7.0 * R_J_KG_K * (total_k - throat_k))
    expected = 0.03 * exit_pa / (R_J_KG_K * throat_k) * velocity
    assert compressible_flow_kg_s(0.03, total_pa, exit_pa, total_k) == pytest.approx(expected, rel=1e-12)


def test_choked_throat_ignores_exit_pressure():
    flow = compressible_flow_kg_s(0.01, 100e3, np.array([52.8e3, 40e3, 10e3]), 300.0)
    np.testing.assert_allclose(flow, flow[0], rtol=1e-6)
    np.testing.assert_allclose(flow[0], 0.040418 * 0.01 * 100e3 / np.sqrt(300.0), rtol=1e-4)


def test_duct_without_head_has_no_flow():
    still = cruise(total_pressure_pa=float(standard_pressure_pa(11887.0)))
    assert RAM_DUCT.predict({}, still)["ram_flow_kg_s"] == 0.0


def test_throat_passes_nothing_backwards():
    assert compressible_flow_kg_s(0.01, 100e3, 101e3, 300.0) == 0.0


def test_textbook_cruise_flow_has_pack_size():
    areas = {"ram_area_closed_m2": 0.004, "ram_area_open_m2": 0.05, "ram_core_area_m2": 0.04, "ram_exit_area_m2": 0.06}
    textbook = RAM_DUCT.calibrated(areas | {"ram_door_high": 0.5, "ram_recovery": 0.9})
    shut, open_ = textbook.predict({}, cruise(ram_door_open=np.array([0.05, 0.6])))["ram_flow_kg_s"]
    assert 0.3 < shut < 1.5 < open_ < 3.5


def test_nominal_cruise_flow_has_pack_size():
    assert 1.0 < RAM_DUCT.predict({}, cruise(ram_door_open=0.6))["ram_flow_kg_s"] < 2.0


def test_missing_altitude_leaves_mach():
    missing = static_pressure_pa(np.array([np.nan]), 0.85, cruise()["total_pressure_pa"])
    np.testing.assert_allclose(missing, static_pressure_pa(np.array([11887.0]), 0.85, 0.0), rtol=1e-12)


def test_colder_air_flows_more():
    cold, warm = (RAM_DUCT.predict({}, cruise(tat_k=t))["ram_flow_kg_s"] for t in (240.0, 260.0))
    assert cold / warm == pytest.approx(np.sqrt(260.0 / 240.0), rel=1e-12)
