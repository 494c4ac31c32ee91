"""The centrifugal compressor of the cabin air supply: equations (2) to (6) of the paper, and efficiency."""

import numpy as np

from hdt_core.physics.air import GAMMA, R_J_KG_K, density_kg_m3
from hdt_core.physics.model import Array, Param, PhysicsModel, Signal

HEAD = (GAMMA - 1.0) / GAMMA


def inlet_flow_kg_s(group_m3: Array, inlet_pa: Array, inlet_k: Array, speed_rad_s: Array) -> Array:
    r"""Mass flow by equations (2)-(4), which only know the product G = A D tan(beta). [kg/s]

    Parameters
    ----------
    group_m3 : array
        Inlet area times eye diameter times the tangent of the blade angle from tangential. [m3]

    Notes
    -----
    .. math:: M = \rho A V, \quad V = U \tan\beta, \quad U = \pi D N / 60 = \omega D / 2
       \quad\Rightarrow\quad M = \tfrac12 \rho\, \omega\, G

    Examples
    --------
    >>> float(inlet_flow_kg_s(*(np.float64(v) for v in (7.5868e-4, 37.6e3, 251.0, 3194.0)))).__round__(3)
    0.632
    """
    return 0.5 * density_kg_m3(inlet_pa, inlet_k) * speed_rad_s * group_m3


def area_diameter_tan_beta_m3(flow_kg_s: Array, inlet_pa: Array, inlet_k: Array, speed_rad_s: Array) -> Array:
    """G = A D tan(beta) from one sample: all that equations (2)-(4) can identify. [m3]

    Area, diameter and angle come apart only by outside knowledge (a prior on the angle, a dynamic pressure).
    """
    return 2.0 * flow_kg_s / (density_kg_m3(inlet_pa, inlet_k) * speed_rad_s)


def group_at_m3(vda_counts: Array, group_m3: Array, at_counts: Array, slope_m3_per_count: Array) -> Array:
    """G = A D tan(beta) with the diffuser at a position: a wider one lets more through at the same speed. [m3]

    The paper's angle is a constant, which would fix flow over density and speed for good. What is seen moves with the
    diffuser (`group_m3` at `at_counts`); a line is enough.
    """
    return group_m3 + slope_m3_per_count * (vda_counts - at_counts)


def pressure_ratio(diameter_m: Array, inlet_k: Array, speed_rad_s: Array) -> Array:
    r"""Pressure ratio by equation (5). [-]

    Notes
    -----
    .. math:: r_p = \left[1 + \frac{\gamma-1}{\gamma} \frac{(\omega D/2)^2}{P_i v_i}\right]^{\gamma/(\gamma-1)},
       \quad P_i v_i = R T_i

    It sets the isentropic head equal to the square of the tip speed, slip times efficiency equal to 1, so D is an
    *effective* diameter: the true one times the square root of slip times efficiency.

    Examples
    --------
    At 36,500 rpm, the paper's 0.1731 m:

    >>> round(float(pressure_ratio(np.float64(0.1731), np.float64(248.0), np.float64(36500 * np.pi / 30))), 2)
    3.58
    """
    return (1.0 + HEAD * (0.5 * speed_rad_s * diameter_m) ** 2 / (R_J_KG_K * inlet_k)) ** (1.0 / HEAD)


def effective_diameter_m(inlet_pa: Array, exit_pa: Array, inlet_k: Array, speed_rad_s: Array) -> Array:
    """Diameter that explains a pressure ratio: equation (5) solved in closed form. [m]

    NaN where the exit pressure is the lower.

    Examples
    --------
    >>> d = effective_diameter_m(*(np.float64(v) for v in (37.6e3, 95.1e3, 251.0, 30500 * np.pi / 30)))
    >>> round(float(d), 3)
    0.173
    """
    head = (exit_pa / inlet_pa) ** HEAD - 1.0
    with np.errstate(invalid="ignore"):
        return 2.0 / speed_rad_s * np.sqrt(head * R_J_KG_K * inlet_k / HEAD)


def expected_diameter_m(vda_counts: Array, intercept_m: Array, slope_m_per_count: Array) -> Array:
    """Effective diameter that the diffuser's position calls for, equation (6). [m]

    The paper prints 01731 - 2.9304e-05 VDA; only 0.1731 m makes sense.
    """
    return intercept_m + slope_m_per_count * vda_counts


def isentropic_efficiency(inlet_pa: Array, exit_pa: Array, inlet_k: Array, exit_k: Array) -> Array:
    """Isentropic over actual rise of total temperature. [-]

    References
    ----------
    .. [1] S. L. Dixon and C. A. Hall, Fluid Mechanics and Thermodynamics of Turbomachinery, 7th ed., 2014, eq. 1.50.

    Examples
    --------
    >>> round(float(isentropic_efficiency(*(np.float64(v) for v in (1.0, 2.0, 300.0, 387.61)))), 3)
    0.75
    """
    return inlet_k * ((exit_pa / inlet_pa) ** HEAD - 1.0) / (exit_k - inlet_k)


def exit_temperature_k(inlet_k: Array, ratio: Array, efficiency: Array) -> Array:
    """Total temperature at the exit. [K]"""
    return inlet_k * (1.0 + (ratio**HEAD - 1.0) / efficiency)


def compression_exit_k(
    *, cc_in_k: Array, cc_pressure_ratio: Array, cc_efficiency: Array, cc_efficiency_loss: Array
) -> Array:
    """Exit temperature at a pressure ratio; arguments as declared in `COMPRESSION`. [K]"""
    return exit_temperature_k(cc_in_k, cc_pressure_ratio, cc_efficiency * (1.0 - cc_efficiency_loss))


def compressor(
    *,
    cc_speed_rad_s: Array,
    cc_in_k: Array,
    cc_in_pa: Array,
    vda_counts: Array,
    cc_area_diameter_tan_beta_m3: Array,
    cc_diameter_vda_intercept: Array,
    cc_diameter_vda_slope: Array,
    cc_efficiency: Array,
    cc_diameter_loss: Array,
    cc_efficiency_loss: Array,
) -> tuple[Array, Array, Array]:
    """Flow [kg/s], exit pressure [Pa] and exit temperature [K]; arguments as declared in `COMPRESSOR`."""
    flow_kg_s = inlet_flow_kg_s(cc_area_diameter_tan_beta_m3, cc_in_pa, cc_in_k, cc_speed_rad_s)
    as_built_m = expected_diameter_m(vda_counts, cc_diameter_vda_intercept, cc_diameter_vda_slope)
    ratio = pressure_ratio((1.0 - cc_diameter_loss) * as_built_m, cc_in_k, cc_speed_rad_s)
    exit_k = compression_exit_k(
        cc_in_k=cc_in_k,
        cc_pressure_ratio=ratio,
        cc_efficiency=cc_efficiency,
        cc_efficiency_loss=cc_efficiency_loss,
    )
    return flow_kg_s, cc_in_pa * ratio, exit_k


COMPRESSOR = PhysicsModel(
    name="compressor",
    inputs=(
        Signal("cc_speed_rad_s", "rad/s", sigma=3.0),
        Signal("cc_in_k", "K", sigma=0.5, bias_sd=1.0),
        Signal("cc_in_pa", "Pa", sigma=150.0, gain_sd=0.003),
        Signal("vda_counts", "count", sigma=5.0),
    ),
    params=(
        Param("cc_area_diameter_tan_beta_m3", "m3", 7.6e-4, (1e-4, 5e-3), "design", sd=4e-4),
        Param("cc_diameter_vda_intercept", "m", 0.1731, (0.05, 0.5), "design", sd=0.01),
        Param("cc_diameter_vda_slope", "m/count", -2.9304e-5, (-3e-4, 3e-4), "design", sd=2e-5),
        Param("cc_efficiency", "-", 0.75, (0.4, 0.95), "design", sd=0.05),
        Param("cc_diameter_loss", "-", 0.0, (-0.1, 0.5), "health", drift=0.001, unit_sd=0.04),
        Param("cc_efficiency_loss", "-", 0.0, (-0.1, 0.5), "health", drift=0.001, unit_sd=0.008),
    ),
    outputs=(
        Signal("cc_flow_kg_s", "kg/s", sigma=0.01, gain_sd=0.02),
        Signal("cc_out_pa", "Pa", sigma=400.0, gain_sd=0.004),
        Signal("cc_out_k", "K", sigma=0.7),
    ),
    equations=compressor,
)

COMPRESSION = PhysicsModel(
    name="compression",
    inputs=(COMPRESSOR.signal("cc_in_k"), Signal("cc_pressure_ratio", "-")),
    params=tuple(COMPRESSOR.param(name) for name in ("cc_efficiency", "cc_efficiency_loss")),
    outputs=(COMPRESSOR.signal("cc_out_k"),),
    equations=compression_exit_k,
)
"""Its efficiency alone, at the pressure ratio as measured: a sample's ratio scatters about equation (6) by 6 %, which
would count as an error of the temperature."""
