"""The air-to-air heat exchanger of the pack: heat that its air takes up, conductance by the flows, outlets.

The default for health. The paper's equations (7)-(8) are in `lumped_exchanger`.
"""

from hdt_core.physics.effectiveness import crossflow_effectiveness, crossflow_ntu
from hdt_core.physics.model import Array, Param, PhysicsModel, Signal

REFERENCE_HOT_FLOW_KG_S = 0.9
REFERENCE_RAM_FLOW_KG_S = 1.6
"""Flows at which `hx_ua_reference_w_k` is stated: those of an average cruise. [kg/s]"""
REFERENCE_HOT_FILM_K, REFERENCE_COLD_FILM_K = 355.0, 285.0
"""And its film temperatures, a quarter of the way from each inlet to the other, at inlets of 390 and 250 K."""
FILM_EXPONENT = 0.38
"""How a film coefficient grows with absolute temperature at the same flow: k^0.67 mu^-0.27 of air."""
OUTLET_ROUNDS = 4
CP_HOT_J_KG_K, CP_COLD_J_KG_K = 1009.0, 1005.0
"""Constants of equations (7)-(8): specific heat of air at the mean temperature of each side, 330 and 270 K. [J/kg/K]"""
CP_300_J_KG_K, CP_SLOPE, CP_CURVE = 1004.66, 0.05216, 3.556e-4
"""Parabola of `specific_heat_j_kg_k` about 300 K. [J/kg/K], [J/kg/K2], [J/kg/K3]"""
WARMING_ROUNDS = 6


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
    >>> round(specific_heat_j_kg_k(300.0), 2)
    1004.66
    """
    above_k = temperature_k - 300.0
    return CP_300_J_KG_K + CP_SLOPE * above_k + CP_CURVE * above_k**2


def mean_specific_heat_j_kg_k(from_k: Array, to_k: Array) -> Array:
    """Enthalpy difference over temperature difference: the mean of `specific_heat_j_kg_k` between two temperatures.

    Examples
    --------
    >>> round(mean_specific_heat_j_kg_k(300.0, 400.0), 2)
    1008.45
    """
    one_k = from_k - 300.0
    other_k = to_k - 300.0
    square_terms = one_k**2 + one_k * other_k + other_k**2
    return CP_300_J_KG_K + CP_SLOPE / 2.0 * (one_k + other_k) + CP_CURVE / 3.0 * square_terms


def warmed_k(from_k: Array, heat_j_kg: Array) -> Array:
    """Temperature of air from `from_k` after so much heat at constant pressure. [K]

    Each round leaves a few thousandths of the error of the one before, a hundredth after 250 K: 1e-10 K at the end.

    Examples
    --------
    >>> round(warmed_k(300.0, 100845.0), 3)
    400.0
    """
    to_k = from_k + heat_j_kg / mean_specific_heat_j_kg_k(from_k, from_k)
    for _ in range(WARMING_ROUNDS):
        to_k = from_k + heat_j_kg / mean_specific_heat_j_kg_k(from_k, to_k)
    return to_k


def clean_conductance_w_k(
    hot_flow_kg_s: Array,
    ram_flow_kg_s: Array,
    *,
    hx_ua_reference_w_k: Array,
    hx_exponent_hot: Array,
    hx_exponent_cold: Array,
    hx_hot_share: Array,
    hx_wall_share: Array,
    hot_film_gain: Array | float = 1.0,
    cold_film_gain: Array | float = 1.0,
) -> Array:
    r"""Conductance UA of the clean exchanger at these flows. [W/K]

    Parameters
    ----------
    hot_flow_kg_s, ram_flow_kg_s : array
        Mass flow of each side. [kg/s], > 0
    hx_ua_reference_w_k : array
        UA at the reference flows. [W/K]
    hx_exponent_hot, hx_exponent_cold : array
        How each film coefficient grows with its flow. [-] 0.5 to 0.65 for offset-strip fins, 0.8 for plain turbulent.
    hx_hot_share, hx_wall_share : array
        Shares of the resistance at the reference flows that the hot film and the wall hold; the cold film has the rest.
    hot_film_gain, cold_film_gain : array, optional
        What temperature does to each film coefficient (`film_gains`). [-] Some 2 % of UA for 20 K in both.

    Notes
    -----
    .. math:: \frac{1}{UA} = \frac{1}{UA_0}\left[s_h \left(\frac{W_h}{W_{h0}}\right)^{-n_h} + s_w
       + (1 - s_h - s_w) \left(\frac{W_c}{W_{c0}}\right)^{-n_c}\right]

    References
    ----------
    .. [1] W. M. Kays and A. L. London, Compact Heat Exchangers, 3rd ed., 1984, chapter 2.
    .. [2] R. M. Manglik and A. E. Bergles, Exp. Thermal Fluid Sci. 10, 171, 1995.

    Examples
    --------
    >>> film = dict(hx_exponent_hot=0.6, hx_exponent_cold=0.6, hx_hot_share=0.5, hx_wall_share=0.0)
    >>> round(clean_conductance_w_k(0.9, 1.6, hx_ua_reference_w_k=1500.0, **film), 6)
    1500.0
    >>> round(clean_conductance_w_k(1.8, 3.2, hx_ua_reference_w_k=1500.0, **film), 1)
    2273.6
    """
    cold_share = 1.0 - hx_hot_share - hx_wall_share
    hot = film_resistance(hot_flow_kg_s / REFERENCE_HOT_FLOW_KG_S, hx_hot_share, hx_exponent_hot, hot_film_gain)
    cold = film_resistance(ram_flow_kg_s / REFERENCE_RAM_FLOW_KG_S, cold_share, hx_exponent_cold, cold_film_gain)
    return hx_ua_reference_w_k / (hot + hx_wall_share + cold)


def film_resistance(flow_share: Array, share: Array, exponent: Array, gain: Array | float = 1.0) -> Array:
    """Resistance of a film over that of the whole exchanger at the reference flows. [-]

    Parameters
    ----------
    flow_share : array
        Flow over reference flow. [-]
    share, exponent, gain : array
        As in `clean_conductance_w_k`.
    """
    resistance: Array = share / gain * flow_share**-exponent
    return resistance


def film_gains(hot_in_k: Array, cold_in_k: Array) -> tuple[Array, Array]:
    """Film coefficients at these inlet temperatures over those at 390 and 250 K, same flows: hot and cold side. [-]

    Examples
    --------
    >>> hot, cold = film_gains(420.0, 250.0)
    >>> round(hot, 4), round(cold, 4)
    (1.0236, 1.0099)
    """
    hot_film_k = 0.75 * hot_in_k + 0.25 * cold_in_k
    cold_film_k = 0.25 * hot_in_k + 0.75 * cold_in_k
    hot_gain: Array = (hot_film_k / REFERENCE_HOT_FILM_K) ** FILM_EXPONENT
    cold_gain: Array = (cold_film_k / REFERENCE_COLD_FILM_K) ** FILM_EXPONENT
    return hot_gain, cold_gain


def capacity_rates(
    hot_flow_kg_s: Array, ram_flow_kg_s: Array, hot_in_k: Array, hot_out_k: Array, cold_in_k: Array
) -> tuple[Array, Array]:
    """Heat-capacity rate of the hot stream, and over that of the ram air that takes its heat. [W/K], [-]

    Each stream has the specific heat of the mean of its own range, so heat lost is heat won in enthalpy.

    Examples
    --------
    >>> rate, ratio = capacity_rates(0.9, 1.6, 390.0, 300.0, 250.0)
    >>> round(float(rate), 2), round(float(ratio), 4)
    (907.17, 0.5649)
    """
    hot_rate_w_k = hot_flow_kg_s * mean_specific_heat_j_kg_k(hot_in_k, hot_out_k)
    heat_j_kg = hot_rate_w_k * (hot_in_k - hot_out_k) / ram_flow_kg_s
    ram_cp_j_kg_k = mean_specific_heat_j_kg_k(cold_in_k, warmed_k(cold_in_k, heat_j_kg))
    return hot_rate_w_k, hot_rate_w_k / (ram_flow_kg_s * ram_cp_j_kg_k)


def outlets_k(
    hot_flow_kg_s: Array, ram_flow_kg_s: Array, hot_in_k: Array, cold_in_k: Array, ua_w_k: Array
) -> tuple[Array, Array]:
    """Hot and cold outlet temperature of a steady cross-flow exchanger. [K]

    The specific heats are those of `capacity_rates`, which rest on the outlets: a few rounds, each of which leaves
    some 1/400 of the error of the one before, settle both to 1e-8 K.

    Examples
    --------
    >>> hot, cold = outlets_k(0.9, 1.6, 390.0, 250.0, 1500.0)
    >>> round(float(hot), 2), round(float(cold), 2)
    (296.14, 303.01)
    """
    hot_out_k = 0.5 * (hot_in_k + cold_in_k)
    for _ in range(OUTLET_ROUNDS):
        rate_w_k, ratio = capacity_rates(hot_flow_kg_s, ram_flow_kg_s, hot_in_k, hot_out_k, cold_in_k)
        eps_hot = crossflow_effectiveness(ua_w_k / rate_w_k, ua_w_k / rate_w_k * ratio)
        hot_out_k = hot_in_k - eps_hot * (hot_in_k - cold_in_k)
    heat_w = hot_flow_kg_s * mean_specific_heat_j_kg_k(hot_in_k, hot_out_k) * (hot_in_k - hot_out_k)
    return hot_out_k, warmed_k(cold_in_k, heat_w / ram_flow_kg_s)


def measured_conductance_w_k(
    hot_flow_kg_s: Array, ram_flow_kg_s: Array, hot_in_k: Array, hot_out_k: Array, cold_in_k: Array
) -> Array:
    """UA that a cross-flow exchanger must have to show these temperatures at these flows. [W/K]

    NaN where none can: hot air that left warmer than it came, or colder than the balance of heat allows. Specific heats
    are those of `capacity_rates`: within 0.3 % of UA of dry air near 1 bar over a pack's range, and within 1 % (0.3 %
    in the mean) where the hot side is at 2 bar and the real gas counts.

    Examples
    --------
    >>> hot_out_k, _ = outlets_k(0.9, 1.6, 390.0, 250.0, 1500.0)
    >>> round(float(measured_conductance_w_k(0.9, 1.6, 390.0, hot_out_k, 250.0)), 6)
    1500.0
    """
    rate_w_k, ratio = capacity_rates(hot_flow_kg_s, ram_flow_kg_s, hot_in_k, hot_out_k, cold_in_k)
    return crossflow_ntu((hot_in_k - hot_out_k) / (hot_in_k - cold_in_k), ratio) * rate_w_k


def steady_exchanger(
    *, hot_flow_kg_s: Array, ram_flow_kg_s: Array, hot_in_k: Array, cold_in_k: Array, hx_fouling: Array, **clean: Array
) -> tuple[Array, Array]:
    """Hot and cold outlet temperature of a fouled exchanger in steady flow; arguments as in `HEAT_EXCHANGER`. [K]"""
    gains = dict(zip(("hot_film_gain", "cold_film_gain"), film_gains(hot_in_k, cold_in_k), strict=True))
    ua_w_k = (1.0 - hx_fouling) * clean_conductance_w_k(hot_flow_kg_s, ram_flow_kg_s, **clean, **gains)
    return outlets_k(hot_flow_kg_s, ram_flow_kg_s, hot_in_k, cold_in_k, ua_w_k)


TAT = Signal("tat_k", "K", sigma=0.3, bias_sd=0.5)
"""Total air temperature, with one probe an aircraft."""
INPUTS = (
    Signal("hot_flow_kg_s", "kg/s", sigma=0.01, gain_sd=0.02),
    Signal("ram_flow_kg_s", "kg/s"),
    Signal("hot_in_k", "K", sigma=0.4, bias_sd=1.0),
    TAT.rename("cold_in_k"),
)
OUTPUTS = (Signal("hot_out_k", "K", sigma=0.4, bias_sd=1.0), Signal("ram_out_k", "K", sigma=0.4, bias_sd=1.0))
"""Sensor classes of transport aircraft."""

PARAMS = (
    Param("hx_ua_reference_w_k", "W/K", 1700.0, (150.0, 8000.0), "design"),
    Param("hx_exponent_hot", "-", 0.6, (0.3, 0.9), "design"),
    Param("hx_exponent_cold", "-", 0.6, (0.3, 0.9), "design"),
    Param("hx_hot_share", "-", 0.45, (0.1, 0.8), "design"),
    Param("hx_wall_share", "-", 0.1, (0.0, 0.19), "design"),
    Param("hx_fouling", "-", 0.0, (-0.25, 0.9), "health", drift=0.003, unit_sd=0.04),
)

HEAT_EXCHANGER = PhysicsModel(
    name="heat_exchanger", inputs=INPUTS, outputs=OUTPUTS, params=PARAMS, equations=steady_exchanger
)
"""Cross-flow, both streams unmixed, steady: the model of snapshots and of the health parameter."""
