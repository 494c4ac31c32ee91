"""The exchanger on its ram duct, in the signals of an aircraft's record: the declaration that calibration estimates.

Its design is in coordinates with a nearly normal distribution: logarithms of positive quantities, the logit of a share.
Core and exit of the duct cannot be separated in flight, so one resistance represents both.
"""

from collections.abc import Mapping

import numpy as np

from hdt_core.physics.air import GAMMA, R_J_KG_K, standard_pressure_pa, total_to_static_pressure
from hdt_core.physics.heat_exchanger import HEAT_EXCHANGER, TAT, clean_conductance_w_k, outlets_k
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


REFERENCE_FILM_K = 325.0
_AIR_DATA = ("altitude_m", "mach", "total_pressure_pa")
_CORE, _DUCT = ({p.name: p for p in model.params} for model in (HEAT_EXCHANGER, RAM_DUCT))
_REST = Param("ram_rest_area_m2", "m2", REST_AREA_M2, (0.0025, 0.6), "design")
_HOT_FILM = _CORE["hx_hot_share"].nominal / (1.0 - _CORE["hx_wall_share"].nominal)

DESIGN = (
    _CORE["hx_ua_reference_w_k"].in_ln("ln_ua_reference", sd=0.5),
    _CORE["hx_exponent_hot"].with_sd(sd=0.05),
    _CORE["hx_exponent_cold"].with_sd(sd=0.05),
    Param("hot_share_logit", "-", float(np.log(_HOT_FILM / (1.0 - _HOT_FILM))), (-1.5, 1.5), "design", sd=0.3),
    _CORE["hx_wall_share"].with_sd(sd=0.05),
    Param("film_temperature_exponent", "-", 0.15, (-0.5, 0.8), "design", sd=0.15),
    _DUCT["ram_area_closed_m2"].in_ln("ln_door_closed", sd=0.7),
    _DUCT["ram_area_open_m2"].in_ln("ln_door_open", sd=0.4),
    _DUCT["ram_door_low"].with_sd(sd=0.15),
    _DUCT["ram_door_high"].with_sd(sd=0.25),
    _REST.in_ln("ln_rest_area", sd=0.4),
    _DUCT["ram_recovery"].with_sd(sd=0.1),
)
"""Design knowledge before any flight: offset-strip fins (film exponents), balanced resistances, a duct for 1 to 2
kg/s in cruise."""
NAMES = tuple(p.name for p in DESIGN)


def duct_values(design: Array) -> dict[str, Array]:
    """Parameters of `RAM_DUCT` of the clean duct from a design vector in the order of `DESIGN`."""
    p = dict(zip(NAMES, design, strict=True))
    half = np.sqrt(2.0) * np.exp(p["ln_rest_area"])
    return {
        "ram_area_closed_m2": np.exp(p["ln_door_closed"]),
        "ram_area_open_m2": np.exp(p["ln_door_open"]),
        "ram_door_low": p["ram_door_low"],
        "ram_door_high": p["ram_door_high"],
        "ram_core_area_m2": half,
        "ram_exit_area_m2": half,
        "ram_recovery": p["ram_recovery"],
    }


def core_values(design: Array) -> dict[str, Array]:
    """Parameters of `HEAT_EXCHANGER` of the clean core from a design vector."""
    p = dict(zip(NAMES, design, strict=True))
    return {
        "hx_ua_reference_w_k": np.exp(p["ln_ua_reference"]),
        "hx_exponent_hot": p["hx_exponent_hot"],
        "hx_exponent_cold": p["hx_exponent_cold"],
        "hx_hot_share": (1.0 - p["hx_wall_share"]) / (1.0 + np.exp(-p["hot_share_logit"])),
        "hx_wall_share": p["hx_wall_share"],
    }


def clean_ram_flow_kg_s(signals: Mapping[str, Array], design: Array) -> Array:
    """Ram flow of a clean core at this door position. (n,) [kg/s]

    Static pressure of signals `with_static_pressure` is not computed again: a fit varies the design, not the weather.
    """
    static_pa = signals.get("static_pressure_pa")
    if static_pa is None:
        static_pa = static_pressure_pa(*(signals[n] for n in _AIR_DATA))
    door = np.clip(signals["ram_door_open"], 0.0, 1.0)
    air = {n: signals[n] for n in ("total_pressure_pa", "tat_k")}
    return clean_flow_kg_s(static_pa, ram_door_open=door, **air, **duct_values(design))


def with_static_pressure(signals: Mapping[str, Array]) -> dict[str, Array]:
    """Add the static pressure outside, for repeated evaluations of the ram flow."""
    return {**signals, "static_pressure_pa": static_pressure_pa(*(signals[n] for n in _AIR_DATA))}


def ln_clean_conductance(signals: Mapping[str, Array], ram_flow_kg_s: Array, design: Array) -> Array:
    """Logarithm of the UA that the digital system model expects, in W/K. (n,)"""
    clean = clean_conductance_w_k(signals["pack_flow_kg_s"], ram_flow_kg_s, **core_values(design))
    film_k = 0.5 * (signals["hx_in_k"] + signals["tat_k"])
    exponent = design[NAMES.index("film_temperature_exponent")]
    return np.asarray(np.log(clean) + exponent * np.log(film_k / REFERENCE_FILM_K))


def installed_outlets_k(**values: Array) -> tuple[Array, Array]:
    """Hot and ram outlet of a fouled core at the clean duct's flow; arguments as declared in `INSTALLED`. [K]"""
    design = np.stack(np.broadcast_arrays(*(values[name] for name in NAMES)))
    ram_kg_s = clean_ram_flow_kg_s(values, design)
    ua_w_k = (1.0 - values["hx_fouling"]) * np.exp(ln_clean_conductance(values, ram_kg_s, design))
    return outlets_k(values["pack_flow_kg_s"], ram_kg_s, values["hx_in_k"], values["tat_k"], ua_w_k)


_INPUTS = (
    *(RAM_DUCT.signal(name) for name in ("altitude_m", "mach", "tat_k", "total_pressure_pa")),
    HEAT_EXCHANGER.signal("hot_in_k").rename("hx_in_k"),
    RAM_DUCT.signal("ram_door_open"),
    HEAT_EXCHANGER.signal("hot_flow_kg_s").rename("pack_flow_kg_s"),
)
_OUTPUTS = (HEAT_EXCHANGER.signal("hot_out_k").rename("hx_out_k"), HEAT_EXCHANGER.signal("ram_out_k"))
INSTALLED = PhysicsModel(
    "installed_exchanger", _INPUTS, _OUTPUTS, (*DESIGN, _CORE["hx_fouling"]), equations=installed_outlets_k
)
"""Model that the night calibrates (`design`) and tracks (`health`), and that a notebook passes to an `Estimator`."""
