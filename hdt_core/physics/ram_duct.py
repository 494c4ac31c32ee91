"""The ram air duct: flow of outside air through the door and the cold side of the exchanger."""

import numpy as np

from hdt_core.physics.air import GAMMA, R_J_KG_K, standard_pressure_pa, total_to_static_pressure
from hdt_core.physics.model import Array, Param, PhysicsModel, Signal


def door_area_m2(
    ram_door_open: Array, ram_area_closed_m2: Array, ram_area_open_m2: Array, ram_door_low: Array, ram_door_high: Array
) -> Array:
    r"""Effective area CdA of the inlet door at its position. [m2]

    Parameters
    ----------
    ram_door_open : array
        Door position, 0 closed to 1 open. [-]
    ram_area_closed_m2, ram_area_open_m2 : array
        CdA at both ends; leakage keeps the first above 0. [m2]
    ram_door_low, ram_door_high : array
        Shape, 0 to 1: the first inner coefficient, and how far the second lies between it and 1. [-]
        (1/3, 1/2) is linear.

    Notes
    -----
    A cubic in Bernstein form with increasing coefficients, so monotone whatever the parameters within bounds:

    .. math:: s(d) = 3 b_1 d (1-d)^2 + 3 b_2 d^2 (1-d) + d^3, \quad b_2 = b_1 + (1 - b_1) g

    References
    ----------
    .. [1] G. Farin, Curves and Surfaces for CAGD, 5th ed., 2002, chapter 5 (variation diminishing).

    Examples
    --------
    >>> round(float(door_area_m2(np.float64(0.5), 0.002, 0.03, 1 / 3, 0.5)), 6)
    0.016
    """
    d = ram_door_open
    second = ram_door_low + (1.0 - ram_door_low) * ram_door_high
    share = 3.0 * ram_door_low * d * (1.0 - d) ** 2 + 3.0 * second * d**2 * (1.0 - d) + d**3
    return ram_area_closed_m2 + (ram_area_open_m2 - ram_area_closed_m2) * share


def series_area_m2(*areas_m2: Array) -> Array:
    r"""Effective area of restrictions one after another. [m2]

    Notes
    -----
    Pressure losses add: :math:`1/A^2 = \sum 1/A_i^2`. A core of loss coefficient K and face area A counts
    as A / sqrt(K).

    Examples
    --------
    >>> round(float(series_area_m2(np.float64(0.03), np.float64(0.04))), 4)
    0.024
    """
    inverse = sum(1.0 / a**2 for a in areas_m2)
    return 1.0 / np.sqrt(inverse)


def compressible_flow_kg_s(area_m2: Array, total_pa: Array, exit_pa: Array, total_k: Array) -> Array:
    r"""Flow through an effective area as an isentropic nozzle passes it, choked where the ratio calls for it. [kg/s]

    Notes
    -----
    .. math:: W = A \frac{p_t}{\sqrt{R T_t}} \sqrt{\frac{2\gamma}{\gamma-1}
       \left(r^{2/\gamma} - r^{(\gamma+1)/\gamma}\right)}, \quad r = \max(p_e / p_t, 0.528)

    References
    ----------
    .. [1] NACA Report 1135, 1953; ISO 9300:2022 for the choked limit.

    Examples
    --------
    Sea level air through 1 m2 into vacuum, the textbook's 0.0404 p A / sqrt(T):

    >>> round(float(compressible_flow_kg_s(*(np.float64(v) for v in (1.0, 1.0, 0.0, 1.0)))), 4)
    0.0404
    """
    critical = (2.0 / (GAMMA + 1.0)) ** (GAMMA / (GAMMA - 1.0))
    ratio = np.minimum(np.maximum(exit_pa / total_pa, critical), 1.0)
    head: Array = 2.0 * GAMMA / (GAMMA - 1.0) * (ratio ** (2.0 / GAMMA) - ratio ** ((GAMMA + 1.0) / GAMMA))
    flow_kg_s: Array = area_m2 * total_pa * np.sqrt(head / (R_J_KG_K * total_k))
    return flow_kg_s


def static_pressure_pa(altitude_m: Array, mach: Array, total_pressure_pa: Array) -> Array:
    """Static pressure outside: from altitude, or from total pressure and Mach where altitude is missing. [Pa]"""
    from_altitude_pa = standard_pressure_pa(altitude_m)
    return np.where(np.isnan(altitude_m), total_pressure_pa / total_to_static_pressure(mach), from_altitude_pa)


def ram_flow(
    *, altitude_m: Array, mach: Array, total_pressure_pa: Array, ram_flow_loss: Array, **clean: Array
) -> Array:
    """Mass flow of ram air; arguments as declared in `RAM_DUCT`. [kg/s]

    Door, core and exit in series, driven from the recovered total pressure to the static pressure outside, with the
    compressible nozzle law: at Mach 0.85 the incompressible one reads 10 % high or more.
    """
    static_pa = static_pressure_pa(altitude_m, mach, total_pressure_pa)
    return (1.0 - ram_flow_loss) * clean_flow_kg_s(static_pa, total_pressure_pa=total_pressure_pa, **clean)


def clean_flow_kg_s(
    static_pa: Array,
    *,
    ram_door_open: Array,
    total_pressure_pa: Array,
    tat_k: Array,
    ram_area_closed_m2: Array,
    ram_area_open_m2: Array,
    ram_door_low: Array,
    ram_door_high: Array,
    ram_core_area_m2: Array,
    ram_exit_area_m2: Array,
    ram_recovery: Array,
) -> Array:
    """Mass flow of ram air through a clean duct, the static pressure outside known. [kg/s]"""
    door_m2 = door_area_m2(ram_door_open, ram_area_closed_m2, ram_area_open_m2, ram_door_low, ram_door_high)
    area_m2 = series_area_m2(door_m2, ram_core_area_m2, ram_exit_area_m2)
    recovered_pa = static_pa + ram_recovery * (total_pressure_pa - static_pa)
    return compressible_flow_kg_s(area_m2, recovered_pa, static_pa, tat_k)


TAT = Signal("tat_k", "K", sigma=0.3, bias_sd=0.5)
"""Total air temperature, with one probe an aircraft."""
REST_AREA_M2 = 0.025
"""Of core and exit in series."""
RAM_DUCT = PhysicsModel(
    name="ram_duct",
    inputs=(
        Signal("ram_door_open", "-", sigma=0.006, bias_sd=0.01),
        Signal("total_pressure_pa", "Pa", sigma=40.0, gain_sd=0.002),
        TAT,
        Signal("altitude_m", "m", sigma=10.0),
        Signal("mach", "-", sigma=0.002),
    ),
    params=(
        Param("ram_area_closed_m2", "m2", 0.003, (1.2e-4, 0.05), "design"),
        Param("ram_area_open_m2", "m2", 0.04, (0.0067, 0.6), "design"),
        Param("ram_door_low", "-", 1.0 / 3.0, (0.02, 0.98), "design"),
        Param("ram_door_high", "-", 0.6, (0.02, 0.98), "design"),
        Param("ram_core_area_m2", "m2", 2.0**0.5 * REST_AREA_M2, (0.0035, 0.85), "design"),
        Param("ram_exit_area_m2", "m2", 2.0**0.5 * REST_AREA_M2, (0.0035, 0.85), "design"),
        Param("ram_recovery", "-", 0.8, (0.4, 1.0), "design"),
        Param("ram_flow_loss", "-", 0.0, (-0.1, 0.8), "health", drift=0.002),
    ),
    outputs=(Signal("ram_flow_kg_s", "kg/s"),),
    equations=ram_flow,
)
"""The ram flow has no sensor; its map errs by 4 to 10 %, which belongs to the uncertainty of every conductance."""
