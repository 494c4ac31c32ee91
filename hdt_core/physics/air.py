"""Dry air: its properties, the standard atmosphere, and total against static conditions.

Written so that arrays and complex numbers pass through: every estimator differentiates these.
"""

import numpy as np

from hdt_core.physics.model import Array

R_J_KG_K = 287.05287
"""Specific gas constant of dry air. [J/kg/K] (ICAO Doc 7488/3)"""
GAMMA = 1.4
"""Ratio of specific heats of the ICAO atmosphere and of pitot theory. [-]"""

G0_M_S2 = 9.80665
SEA_LEVEL_K, SEA_LEVEL_PA, LAPSE_K_M, TROPOPAUSE_M = 288.15, 101325.0, 0.0065, 11000.0


def density_kg_m3(pressure_pa: Array, temperature_k: Array) -> Array:
    """Density of a perfect gas. [kg/m3]

    Examples
    --------
    >>> round(float(density_kg_m3(np.float64(101325.0), np.float64(288.15))), 4)
    1.225
    """
    return pressure_pa / (R_J_KG_K * temperature_k)


def standard_temperature_k(pressure_altitude_m: Array) -> Array:
    """Temperature of the standard atmosphere. [K]

    Parameters
    ----------
    pressure_altitude_m : array
        Pressure altitude, which is a geopotential height. [m], -1000 to 20000

    References
    ----------
    .. [1] ICAO Doc 7488/3, Manual of the ICAO Standard Atmosphere, 1993.

    Examples
    --------
    >>> round(float(standard_temperature_k(np.float64(10000.0))), 2)
    223.15
    """
    return SEA_LEVEL_K - LAPSE_K_M * np.minimum(pressure_altitude_m, TROPOPAUSE_M)


def standard_pressure_pa(pressure_altitude_m: Array) -> Array:
    r"""Pressure of the standard atmosphere: the static pressure an altimeter reads. [Pa]

    Parameters
    ----------
    pressure_altitude_m : array
        Pressure altitude. [m], -1000 to 20000

    Notes
    -----
    .. math:: p = p_0 (T / T_0)^{g_0 / (R L)}, \quad p = p_{11} e^{-g_0 (h - 11000) / (R T_{11})}

    A closed form and not the `ambiance` package, which takes geometric height: an altimeter gives geopotential height.
    The tests hold the two together.

    References
    ----------
    .. [1] ICAO Doc 7488/3, Manual of the ICAO Standard Atmosphere, 1993.

    Examples
    --------
    >>> round(float(standard_pressure_pa(np.float64(11000.0))), 1)
    22632.0
    """
    temperature_k = standard_temperature_k(pressure_altitude_m)
    above_m = np.maximum(pressure_altitude_m - TROPOPAUSE_M, 0.0)
    below = (temperature_k / SEA_LEVEL_K) ** (G0_M_S2 / (R_J_KG_K * LAPSE_K_M))
    return SEA_LEVEL_PA * below * np.exp(-G0_M_S2 * above_m / (R_J_KG_K * temperature_k))


def total_to_static_pressure(mach: Array) -> Array:
    r"""Total over static pressure of an isentropic stream. [-]

    Notes
    -----
    .. math:: p_t / p = (1 + 0.2 M^2)^{3.5}

    References
    ----------
    .. [1] NACA Report 1135, Equations, Tables, and Charts for Compressible Flow, 1953, equation 44.

    Examples
    --------
    >>> round(float(total_to_static_pressure(np.float64(0.85))), 5)
    1.60382
    """
    return (1.0 + 0.5 * (GAMMA - 1.0) * mach**2) ** (GAMMA / (GAMMA - 1.0))


def total_to_static_temperature(mach: Array) -> Array:
    """Total over static temperature. [-]

    References
    ----------
    .. [1] NACA Report 1135, 1953, equation 43.

    Examples
    --------
    >>> round(float(total_to_static_temperature(np.float64(0.85))), 4)
    1.1445
    """
    return 1.0 + 0.5 * (GAMMA - 1.0) * mach**2


def mach_from_pressures(total_pa: Array, static_pa: Array) -> Array:
    """Mach number of a subsonic stream from its total and static pressure. [-]

    Examples
    --------
    >>> round(float(mach_from_pressures(np.float64(1.60382), np.float64(1.0))), 4)
    0.85
    """
    ratio = np.maximum(total_pa / static_pa, 1.0)
    return np.sqrt(2.0 / (GAMMA - 1.0) * (ratio ** ((GAMMA - 1.0) / GAMMA) - 1.0))


REFERENCE_M, REFERENCE_MACH = 11_000.0, 0.84
HIGH_CRUISE_M = 12_497.0
"""41,000 ft, the highest usual cruise level: thin air demands most of a compressor. [m]"""
HOT_DAY_K = 15.0
"""The hot day that a margin is stated for: the standard atmosphere and 15 K, at the flight's level, speed and flow."""


def reference_air(n: int, level_m: float = REFERENCE_M) -> dict[str, Array]:
    """Return `altitude_m, mach, tat_k, total_pressure_pa` of the reference cruise, or of another level, (n,) each."""
    altitude_m = np.full(n, level_m)
    mach = np.full(n, REFERENCE_MACH)
    return {
        "altitude_m": altitude_m,
        "mach": mach,
        "tat_k": standard_temperature_k(altitude_m) * total_to_static_temperature(mach),
        "total_pressure_pa": standard_pressure_pa(altitude_m) * total_to_static_pressure(mach),
    }


def hot_day_tat_k(altitude_m: Array, mach: Array) -> Array:
    """Compute total air temperature of the hot day. [K]"""
    return np.asarray((standard_temperature_k(altitude_m) + HOT_DAY_K) * total_to_static_temperature(mach))
