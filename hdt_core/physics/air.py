"""Dry air: its properties, the standard atmosphere, and total against static conditions.

Written so that arrays and complex numbers pass through: every estimator differentiates these.
"""

import numpy as np

from hdt_core.physics.model import Array

R_J_KG_K = 287.05287
"""Specific gas constant of dry air. [J/kg/K] (ICAO Doc 7488/3)"""
GAMMA = 1.4
"""Ratio of specific heats of the ICAO atmosphere and of pitot theory. [-]"""

CP_300_J_KG_K, CP_SLOPE, CP_CURVE = 1004.66, 0.05216, 3.556e-4
"""Parabola of `specific_heat_j_kg_k` about 300 K. [J/kg/K], [J/kg/K2], [J/kg/K3]"""

WARMING_ROUNDS = 6

G0_M_S2 = 9.80665
SEA_LEVEL_K, SEA_LEVEL_PA, LAPSE_K_M, TROPOPAUSE_M = 288.15, 101325.0, 0.0065, 11000.0


def specific_heat_j_kg_k(temperature_k: Array) -> Array:
    r"""Isobaric specific heat of dry air at low pressure. [J/kg/K]

    Parameters
    ----------
    temperature_k : array
        Static temperature. [K], 210 to 500

    Notes
    -----
    .. math:: c_p = 1004.66 + 0.05216 (T - 300) + 3.556 \cdot 10^{-4} (T - 300)^2

    A least-squares parabola through the ideal-gas heat capacity of [1]_, within 0.4 J/kg/K of it. At 250 kPa the real
    gas lies 0.1 % (400 K) to 0.6 % (250 K) above.

    References
    ----------
    .. [1] E. W. Lemmon et al., J. Phys. Chem. Ref. Data 29, 331, 2000 (as CoolProp evaluates it).

    Examples
    --------
    >>> round(float(specific_heat_j_kg_k(np.float64(300.0))), 2)
    1004.66
    """
    above_k = temperature_k - 300.0
    return CP_300_J_KG_K + CP_SLOPE * above_k + CP_CURVE * above_k**2


def mean_specific_heat_j_kg_k(from_k: Array, to_k: Array) -> Array:
    """Enthalpy difference over temperature difference: the mean of `specific_heat_j_kg_k` between two temperatures.

    Examples
    --------
    >>> round(float(mean_specific_heat_j_kg_k(np.float64(300.0), np.float64(400.0))), 2)
    1008.45
    """
    one_k, other_k = from_k - 300.0, to_k - 300.0
    square_terms = one_k**2 + one_k * other_k + other_k**2
    return CP_300_J_KG_K + CP_SLOPE / 2.0 * (one_k + other_k) + CP_CURVE / 3.0 * square_terms


def warmed_k(from_k: Array, heat_j_kg: Array) -> Array:
    """Temperature of air from `from_k` after so much heat at constant pressure. [K]

    Each round leaves a few thousandths of the error of the one before, a hundredth after 250 K: 1e-10 K at the end.

    Examples
    --------
    >>> round(float(warmed_k(np.float64(300.0), np.float64(100845.0))), 3)
    400.0
    """
    to_k = from_k + heat_j_kg / mean_specific_heat_j_kg_k(from_k, from_k)
    for _ in range(WARMING_ROUNDS):
        to_k = from_k + heat_j_kg / mean_specific_heat_j_kg_k(from_k, to_k)
    return to_k


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
