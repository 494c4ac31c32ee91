"""The compressor: closed forms against the equations they solve, and what cannot be told apart."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdt_core.physics.compressor import (
    COMPRESSOR,
    area_diameter_tan_beta_m3,
    effective_diameter_m,
    exit_temperature_k,
    expected_diameter_m,
    inlet_flow_kg_s,
    isentropic_efficiency,
    pressure_ratio,
)

RPM = np.pi / 30.0
speeds = st.floats(1000.0, 4500.0)
inlets_k = st.floats(230.0, 310.0)

CRUISE_TABLE = [  # inlet K, kPa, exit kPa, rpm at D 0.1731 m, exit degC, kW; efficiency 0.75, 0.42 kg/s
    (292.0, 105.7, 121.6, 12060.0, 35.0, 7.0),
    (260.0, 45.3, 96.6, 27700.0, 70.0, 35.0),
    (251.0, 37.6, 95.1, 30500.0, 79.0, 43.0),
    (248.0, 31.1, 93.5, 33500.0, 97.0, 52.0),
    (248.0, 25.7, 93.2, 36800.0, 122.0, 62.0),
]


@pytest.mark.parametrize("row", CRUISE_TABLE)
def test_cabin_compressor_cruise_table(row):
    inlet_k, inlet_kpa, exit_kpa, rpm, exit_degc, power_kw = row
    diameter = effective_diameter_m(inlet_kpa, exit_kpa, inlet_k, rpm * RPM)
    assert diameter == pytest.approx(0.1731, rel=0.012)
    exit_k = exit_temperature_k(inlet_k, exit_kpa / inlet_kpa, 0.75)
    assert exit_k - 273.15 == pytest.approx(exit_degc, abs=2.0)
    assert 0.42 * 1004.685 * (exit_k - inlet_k) / 1000.0 == pytest.approx(power_kw, abs=1.0)


def test_equation_6_needs_its_decimal_point():
    """At 36,500 rpm 0.1731 m is a pressure ratio of 3.58; 01731 as printed is nothing a machine can do."""
    assert pressure_ratio(0.1731, 248.0, 36500.0 * RPM) == pytest.approx(3.58, abs=0.01)
    assert pressure_ratio(1731.0, 248.0, 36500.0 * RPM) > 1e20


@given(st.floats(0.08, 0.3), inlets_k, speeds)
def test_diameter_comes_back_from_the_pressure_ratio(diameter, inlet_k, speed):
    ratio = pressure_ratio(diameter, inlet_k, speed)
    assert effective_diameter_m(1.0, ratio, inlet_k, speed) == pytest.approx(diameter, rel=1e-9)


@given(st.floats(1e-4, 5e-3), inlets_k, speeds)
def test_group_comes_back_from_the_flow(group, inlet_k, speed):
    flow = inlet_flow_kg_s(group, 37.6e3, inlet_k, speed)
    assert area_diameter_tan_beta_m3(flow, 37.6e3, inlet_k, speed) == pytest.approx(group, rel=1e-12)


def test_equations_2_to_4_written_out_give_the_group_s_flow():
    area, diameter, beta, rpm = 0.0100, 0.11, np.radians(35.0), 30500.0
    velocity = np.pi * diameter * rpm / 60.0 * np.tan(beta)
    expected = 37.6e3 / (287.05287 * 251.0) * area * velocity
    assert inlet_flow_kg_s(area * diameter * np.tan(beta), 37.6e3, 251.0, rpm * RPM) == pytest.approx(
        expected, rel=1e-12
    )


def test_area_diameter_and_angle_cannot_be_told_apart():
    """Fisher information of (ln A, ln D, beta) has rank 1, however many points there are."""
    rng = np.random.default_rng(5)
    inlet_pa, inlet_k, speed = (
        rng.uniform(25e3, 50e3, 500),
        rng.uniform(240.0, 265.0, 500),
        rng.uniform(2500.0, 3900.0, 500),
    )
    point = np.array([np.log(0.01), np.log(0.11), 0.61])

    def ln_flow(x):
        return np.log(inlet_flow_kg_s(np.exp(x[0] + x[1]) * np.tan(x[2]), inlet_pa, inlet_k, speed))

    columns = [ln_flow(point + 1e-30j * np.eye(3)[i]).imag / 1e-30 for i in range(3)]
    eigenvalues = np.linalg.eigvalsh(np.array(columns) @ np.array(columns).T)
    assert eigenvalues[1] < 1e-9 * eigenvalues[2]


@given(st.floats(1.05, 4.0), st.floats(0.5, 0.9))
def test_efficiency_comes_back_from_the_exit_temperature(ratio, efficiency):
    exit_k = exit_temperature_k(250.0, ratio, efficiency)
    assert isentropic_efficiency(1.0, ratio, 250.0, exit_k) == pytest.approx(efficiency, rel=1e-9)


@pytest.mark.parametrize(("what", "gain"), [("ratio", 0.47), ("inlet_k", 0.50), ("speed", -1.0)])
def test_sensitivity_of_the_diameter(what, gain):
    """r_p +1 % is +0.47 % at r_p 3, T +1 % is +0.5 %, N +1 % is -1 %."""
    base = {"inlet_pa": 1.0, "exit_pa": 2.95, "inlet_k": 250.0, "speed_rad_s": 3500.0}
    key = {"ratio": "exit_pa", "inlet_k": "inlet_k", "speed": "speed_rad_s"}[what]
    changed = base | {key: base[key] * (1.0 + 1e-6)}
    assert np.log(effective_diameter_m(**changed) / effective_diameter_m(**base)) / 1e-6 == pytest.approx(
        gain, abs=0.07
    )


def test_declared_model_is_the_equations():
    inputs = {"cc_speed_rad_s": 3194.0, "cc_in_k": 251.0, "cc_in_pa": 37.6e3, "vda_counts": 300.0}
    clean = COMPRESSOR.predict({}, inputs)
    diameter = effective_diameter_m(37.6e3, clean["cc_out_pa"], 251.0, 3194.0)
    assert diameter == pytest.approx(expected_diameter_m(300.0, 0.1731, -2.9304e-5), rel=1e-12)
    assert isentropic_efficiency(37.6e3, clean["cc_out_pa"], 251.0, clean["cc_out_k"]) == pytest.approx(0.75, rel=1e-12)
    worn = COMPRESSOR.predict({"cc_diameter_loss": 0.1, "cc_efficiency_loss": 0.1}, inputs)
    smaller = effective_diameter_m(37.6e3, worn["cc_out_pa"], 251.0, 3194.0)
    assert smaller == pytest.approx(0.9 * diameter, rel=1e-12)


def test_no_diameter_where_the_pressure_falls():
    assert np.isnan(effective_diameter_m(1.0, 0.9, 250.0, 3000.0))
