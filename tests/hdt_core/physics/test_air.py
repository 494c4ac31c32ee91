"""Air against CoolProp, the atmosphere against ambiance, compressible flow against the tables."""

import ambiance
import numpy as np
import pytest
from coolprop import PropsSI

from hdt_core.physics import air


def test_specific_heat_agrees_with_coolprop():
    temperature_k = np.linspace(215.0, 500.0, 20)
    expected = [PropsSI("Cp0mass", "T", t, "P", 1e5, "Air") for t in temperature_k]
    np.testing.assert_allclose(air.specific_heat_j_kg_k(temperature_k), expected, rtol=4e-4)


def test_density_agrees_with_coolprop():
    for pressure_pa, temperature_k in [(26e3, 230.0), (101325.0, 288.15), (250e3, 400.0)]:
        expected = PropsSI("D", "T", temperature_k, "P", pressure_pa, "Air")
        assert air.density_kg_m3(pressure_pa, temperature_k) == pytest.approx(expected, rel=2e-3)


def test_atmosphere_agrees_with_ambiance():
    """`ambiance` takes geometric height, an altimeter gives geopotential height."""
    geometric_m = np.linspace(-500.0, 19900.0, 60)
    standard = ambiance.Atmosphere(geometric_m)
    pressure_altitude_m = ambiance.Atmosphere.geom2geop_height(geometric_m)
    np.testing.assert_allclose(air.standard_pressure_pa(pressure_altitude_m), standard.pressure, rtol=2e-6)
    np.testing.assert_allclose(air.standard_temperature_k(pressure_altitude_m), standard.temperature, rtol=1e-7)
    density = air.density_kg_m3(standard.pressure, standard.temperature)
    np.testing.assert_allclose(density, standard.density, rtol=2e-6)


@pytest.mark.parametrize(
    ("altitude_m", "pressure_pa"),
    [(0.0, 101325.0), (5000.0, 54019.9), (11000.0, 22632.0), (15000.0, 12044.5), (20000.0, 5474.88)],
)
def test_atmosphere_tables(altitude_m, pressure_pa):
    """ICAO Doc 7488/3, geopotential altitude."""
    assert air.standard_pressure_pa(altitude_m) == pytest.approx(pressure_pa, rel=2e-5)


@pytest.mark.parametrize(
    ("mach", "pressure", "temperature"), [(0.5, 0.8430, 0.9524), (0.8, 0.6560, 0.8865), (1.0, 0.5283, 0.8333)]
)
def test_isentropic_tables(mach, pressure, temperature):
    """NACA Report 1135, table I: static over total."""
    assert 1.0 / air.total_to_static_pressure(mach) == pytest.approx(pressure, abs=5e-5)
    assert 1.0 / air.total_to_static_temperature(mach) == pytest.approx(temperature, abs=5e-5)


def test_mach_comes_back_from_its_pressures():
    mach = np.linspace(0.05, 0.95, 19)
    np.testing.assert_allclose(air.mach_from_pressures(air.total_to_static_pressure(mach), 1.0), mach, rtol=1e-12)
    assert air.mach_from_pressures(0.99, 1.0) == 0.0


def test_warmed_air_holds_its_heat_to_a_tenth_of_a_billionth_of_a_kelvin():
    """Specific heat is a parabola about 300 K, its mean that of Simpson's rule."""
    to_k = air.warmed_k(220.0, 2.5e5)
    at = np.array([220.0, 0.5 * (220.0 + to_k), to_k]) - 300.0
    one, middle, other = 1004.66 + 0.05216 * at + 3.556e-4 * at**2
    assert 2.5e5 / ((one + 4.0 * middle + other) / 6.0) == pytest.approx(to_k - 220.0, abs=1e-10)
