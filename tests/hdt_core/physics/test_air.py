"""Air against CoolProp, the atmosphere against ambiance, compressible flow against the tables."""

import ambiance
import numpy as np
import pytest
from CoolProp import CoolProp

from hdt_core.physics import air


@pytest.mark.parametrize(
    ("key", "function", "rtol"),
    [
        ("Cp0mass", air.specific_heat_j_kg_k, 4e-4),
        ("V", air.viscosity_pa_s, 0.02),
        ("L", air.conductivity_w_m_k, 0.03),
    ],
)
def test_properties_agree_with_coolprop(key, function, rtol):
    temperature_k = np.linspace(215.0, 500.0, 20)
    expected = [CoolProp.PropsSI(key, "T", t, "P", 1e5, "Air") for t in temperature_k]
    np.testing.assert_allclose(function(temperature_k), expected, rtol=rtol)


def test_density_agrees_with_coolprop():
    for pressure_pa, temperature_k in [(26e3, 230.0), (101325.0, 288.15), (250e3, 400.0)]:
        expected = CoolProp.PropsSI("D", "T", temperature_k, "P", pressure_pa, "Air")
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
    np.testing.assert_allclose(air.viscosity_pa_s(standard.temperature), standard.dynamic_viscosity, rtol=1e-6)


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
