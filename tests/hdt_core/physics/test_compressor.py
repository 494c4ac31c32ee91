"""Air against references; the compressor's closed forms against its equations; the tables of docs/errata.md."""

import re
from pathlib import Path

import ambiance
import numpy as np
import pytest
from coolprop import PropsSI
from hypothesis import given
from hypothesis import strategies as st

from hdt_core.physics import air
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
from hdt_core.physics.heat_exchanger import outlets_k, specific_heat_j_kg_k, warmed_k
from hdt_core.physics.lumped_exchanger import tied_coefficient_w_k

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
def test_reproduces_cruise_table(row):
    inlet_k, inlet_kpa, exit_kpa, rpm, exit_degc, power_kw = row
    diameter = effective_diameter_m(inlet_kpa, exit_kpa, inlet_k, rpm * RPM)
    assert diameter == pytest.approx(0.1731, rel=0.012)
    exit_k = exit_temperature_k(inlet_k, exit_kpa / inlet_kpa, 0.75)
    assert exit_k - 273.15 == pytest.approx(exit_degc, abs=2.0)
    assert 0.42 * 1004.685 * (exit_k - inlet_k) / 1000.0 == pytest.approx(power_kw, abs=1.0)


def test_equation_6_needs_decimal_point():
    """At 36,500 rpm 0.1731 m is a pressure ratio of 3.58; 01731 as printed is nothing a machine can do."""
    assert pressure_ratio(0.1731, 248.0, 36500.0 * RPM) == pytest.approx(3.58, abs=0.01)
    assert pressure_ratio(1731.0, 248.0, 36500.0 * RPM) > 1e20


@given(st.floats(0.08, 0.3), inlets_k, speeds)
def test_diameter_inverts_pressure_ratio(diameter, inlet_k, speed):
    ratio = pressure_ratio(diameter, inlet_k, speed)
    assert effective_diameter_m(1.0, ratio, inlet_k, speed) == pytest.approx(diameter, rel=1e-9)


@given(st.floats(1e-4, 5e-3), inlets_k, speeds)
def test_group_inverts_flow(group, inlet_k, speed):
    flow = inlet_flow_kg_s(group, 37.6e3, inlet_k, speed)
    assert area_diameter_tan_beta_m3(flow, 37.6e3, inlet_k, speed) == pytest.approx(group, rel=1e-12)


def test_flow_equals_equations_2_to_4():
    area_m2 = 0.0100
    diameter_m = 0.11
    tan_beta = np.tan(np.radians(35.0))
    velocity_m_s = np.pi * diameter_m * 30500.0 / 60.0 * tan_beta
    expected = 37.6e3 / (287.05287 * 251.0) * area_m2 * velocity_m_s
    flow = inlet_flow_kg_s(area_m2 * diameter_m * tan_beta, 37.6e3, 251.0, 30500.0 * RPM)
    assert flow == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("loss", [0.0, 0.1])
def test_readings_invert_declared_model(loss):
    """Of a machine that has lost this share of diameter and efficiency."""
    inputs = {"cc_speed_rad_s": 3194.0, "cc_in_k": 251.0, "cc_in_pa": 37.6e3, "vda_counts": 300.0}
    outlet = COMPRESSOR.predict({"cc_diameter_loss": loss, "cc_efficiency_loss": loss}, inputs)
    diameter = effective_diameter_m(37.6e3, outlet["cc_out_pa"], 251.0, 3194.0)
    efficiency = isentropic_efficiency(37.6e3, outlet["cc_out_pa"], 251.0, outlet["cc_out_k"])
    built = np.array([expected_diameter_m(300.0, 0.1731, -2.9304e-5), 0.75])
    assert (diameter, efficiency) == pytest.approx((1.0 - loss) * built, rel=1e-12)


def test_diameter_needs_a_pressure_rise():
    assert np.isnan(effective_diameter_m(1.0, 0.9, 250.0, 3000.0))


def test_only_the_group_is_identifiable():
    """Fisher information of (ln A, ln D, beta) has rank 1, however many points there are."""
    rng = np.random.default_rng(5)
    inlet_pa = rng.uniform(25e3, 50e3, 500)
    inlet_k = rng.uniform(240.0, 265.0, 500)
    speed = rng.uniform(2500.0, 3900.0, 500)
    point = np.array([np.log(0.01), np.log(0.11), 0.61])

    def ln_flow(x):
        return np.log(inlet_flow_kg_s(np.exp(x[0] + x[1]) * np.tan(x[2]), inlet_pa, inlet_k, speed))

    columns = [ln_flow(point + 1e-30j * np.eye(3)[i]).imag / 1e-30 for i in range(3)]
    eigenvalues = np.linalg.eigvalsh(np.array(columns) @ np.array(columns).T)
    assert eigenvalues[1] < 1e-9 * eigenvalues[2]


@given(st.floats(1.05, 4.0), st.floats(0.5, 0.9))
def test_efficiency_inverts_exit_temperature(ratio, efficiency):
    exit_k = exit_temperature_k(250.0, ratio, efficiency)
    assert isentropic_efficiency(1.0, ratio, 250.0, exit_k) == pytest.approx(efficiency, rel=1e-9)


@pytest.mark.parametrize(("what", "gain"), [("ratio", 0.47), ("inlet_k", 0.50), ("speed", -1.0)])
def test_diameter_has_known_gains(what, gain):
    """r_p +1 % is +0.47 % at r_p 3, T +1 % is +0.5 %, N +1 % is -1 %."""
    base = {"inlet_pa": 1.0, "exit_pa": 2.95, "inlet_k": 250.0, "speed_rad_s": 3500.0}
    key = {"ratio": "exit_pa", "inlet_k": "inlet_k", "speed": "speed_rad_s"}[what]
    changed = base | {key: base[key] * (1.0 + 1e-6)}
    slope = np.log(effective_diameter_m(**changed) / effective_diameter_m(**base)) / 1e-6
    assert slope == pytest.approx(gain, abs=0.07)


def test_specific_heat_agrees_with_coolprop():
    temperature_k = np.linspace(215.0, 500.0, 20)
    expected = [PropsSI("Cp0mass", "T", t, "P", 1e5, "Air") for t in temperature_k]
    np.testing.assert_allclose(specific_heat_j_kg_k(temperature_k), expected, rtol=4e-4)


@pytest.mark.parametrize(("pressure_pa", "temperature_k"), [(26e3, 230.0), (101325.0, 288.15), (250e3, 400.0)])
def test_density_agrees_with_coolprop(pressure_pa, temperature_k):
    expected = PropsSI("D", "T", temperature_k, "P", pressure_pa, "Air")
    assert air.density_kg_m3(pressure_pa, temperature_k) == pytest.approx(expected, rel=2e-3)


def test_mach_inverts_pressure_ratio():
    mach = np.linspace(0.05, 0.95, 19)
    np.testing.assert_allclose(air.mach_from_pressures(air.total_to_static_pressure(mach), 1.0), mach, rtol=1e-12)


def test_mach_is_zero_without_head():
    assert air.mach_from_pressures(0.99, 1.0) == 0.0


def test_atmosphere_agrees_with_ambiance():
    """`ambiance` takes geometric height, an altimeter gives geopotential height."""
    geometric_m = np.linspace(-500.0, 19900.0, 60)
    standard = ambiance.Atmosphere(geometric_m)
    pressure_altitude_m = ambiance.Atmosphere.geom2geop_height(geometric_m)
    np.testing.assert_allclose(air.standard_pressure_pa(pressure_altitude_m), standard.pressure, rtol=2e-6)
    np.testing.assert_allclose(air.standard_temperature_k(pressure_altitude_m), standard.temperature, rtol=1e-7)
    density = air.density_kg_m3(standard.pressure, standard.temperature)
    np.testing.assert_allclose(density, standard.density, rtol=2e-6)


def test_warming_integrates_specific_heat():
    """Specific heat is a parabola about 300 K, its mean that of Simpson's rule."""
    to_k = warmed_k(220.0, 2.5e5)
    at = np.array([220.0, 0.5 * (220.0 + to_k), to_k]) - 300.0
    one, middle, other = 1004.66 + 0.05216 * at + 3.556e-4 * at**2
    assert 2.5e5 / ((one + 4.0 * middle + other) / 6.0) == pytest.approx(to_k - 220.0, abs=1e-10)


@pytest.mark.parametrize(
    ("altitude_m", "pressure_pa"),
    [(0.0, 101325.0), (5000.0, 54019.9), (11000.0, 22632.0), (15000.0, 12044.5), (20000.0, 5474.88)],
)
def test_atmosphere_matches_icao_table(altitude_m, pressure_pa):
    """ICAO Doc 7488/3, geopotential altitude."""
    assert air.standard_pressure_pa(altitude_m) == pytest.approx(pressure_pa, rel=2e-5)


@pytest.mark.parametrize(
    ("mach", "pressure", "temperature"), [(0.5, 0.8430, 0.9524), (0.8, 0.6560, 0.8865), (1.0, 0.5283, 0.8333)]
)
def test_isentropic_ratios_match_naca(mach, pressure, temperature):
    """NACA Report 1135, table I: static over total."""
    assert 1.0 / air.total_to_static_pressure(mach) == pytest.approx(pressure, abs=5e-5)
    assert 1.0 / air.total_to_static_temperature(mach) == pytest.approx(temperature, abs=5e-5)


ERRATA = (Path(__file__).parents[3] / "docs" / "errata.md").read_text(encoding="utf-8")


def rows(heading: str) -> list[list[float]]:
    """Numbers of the table whose header begins like this."""
    table = ERRATA[ERRATA.index(f"| {heading}") :].split("\n\n")[0].splitlines()[2:]
    cells = [line.replace(",", "").strip("| ").split("|") for line in table]
    return [[float(re.findall(r"-?\d+\.?\d*", cell)[-1]) for cell in row] for row in cells]


@pytest.mark.parametrize("row", rows("ram flow, kg/s"), ids=lambda r: f"ram {r[0]}")
def test_tied_coefficient_matches_errata(row):
    ram, *printed, last_ua = row
    at = {"hot_flow_kg_s": 0.9, "ram_flow_kg_s": ram, "hot_in_k": 390.0, "cold_in_k": 250.0}

    def h(ua):
        return tied_coefficient_w_k(**at, hot_out_k=outlets_k(0.9, ram, 390.0, 250.0, ua)[0])

    np.testing.assert_allclose([h(ua) for ua in (800.0, 1200.0, 1600.0)], printed, rtol=1e-3)
    assert h(last_ua - 1.0) > 0.0 > h(last_ua + 1.0)


@pytest.mark.parametrize("row", rows("range of VDA"), ids=lambda r: f"to {r[0]:.0f}")
def test_equation_6_matches_errata(row):
    """The range is printed 0-N, so its number reads as -N."""
    top = abs(row[0])
    diameter = row[1]
    r_squared = row[2]
    assert expected_diameter_m(top, 0.1731, -2.9304e-5) == pytest.approx(diameter, abs=5e-5)
    explained = (2.9304e-5 * top) ** 2 / 12.0
    left = 0.0055**2 * np.pi / 2.0
    assert explained / (explained + left) == pytest.approx(r_squared, abs=5e-3)


RESIMULATED = re.findall(
    r"\| (UKF|EKF|PSO|NLS) \| ([\d.]+), ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|", ERRATA
)


def test_table_2_has_four_methods():
    assert [row[0] for row in RESIMULATED] == ["UKF", "EKF", "PSO", "NLS"]


def positions_m(damping, stiffness):
    """Section 3.2.2 by the book: Euler's rule from rest, 1,001 samples at 0.01 s, 1 kg, sin(pi t) N."""
    x = 0.0
    v = 0.0
    positions = []
    for k in range(1001):
        positions.append(x)
        x, v = x + 0.01 * v, v + 0.01 * (np.sin(np.pi * 0.01 * k) - damping * v - stiffness * x)
    return np.array(positions)


@pytest.mark.parametrize("row", RESIMULATED, ids=lambda row: row[0])
def test_table_2_contradicts_table_1(row):
    """What the page gives for the printed parameters is what they simulate, and not what table 2 prints."""
    damping, stiffness, printed_mse, mse, printed_mape, mape = map(float, row[1:])
    truth = positions_m(0.5, 2.0)
    off = np.abs(positions_m(damping, stiffness) - truth)
    assert np.mean(off**2) == pytest.approx(mse, rel=5e-3, abs=1e-12)
    assert np.mean(off[truth != 0.0] / np.abs(truth[truth != 0.0])) == pytest.approx(mape, rel=5e-3, abs=1e-9)
    rounded = [positions_m(damping + c, stiffness + k) for c in (-5e-4, 5e-4) for k in (-5e-4, 5e-4)]
    assert max(np.mean((x - truth) ** 2) for x in rounded) < 0.75 * printed_mse
    assert abs(mape - printed_mape) > 0.1 * printed_mape
