"""The exchanger on its ram duct, in the signals of an aircraft's record: the declaration that calibration estimates.

Its design is in coordinates with a nearly normal distribution: logarithms of positive quantities, the logit of a share.
Core and exit of the duct cannot be separated in flight, so one resistance represents both.
"""

from collections.abc import Mapping

import numpy as np

from hdt_core.physics.heat_exchanger import HEAT_EXCHANGER, clean_conductance_w_k, outlets_k
from hdt_core.physics.model import Array, Param, PhysicsModel
from hdt_core.physics.ram_duct import RAM_DUCT, REST_AREA_M2, clean_flow_kg_s, static_pressure_pa

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


INPUTS = (
    *(RAM_DUCT.signal(name) for name in ("altitude_m", "mach", "tat_k", "total_pressure_pa")),
    HEAT_EXCHANGER.signal("hot_in_k").rename("hx_in_k"),
    RAM_DUCT.signal("ram_door_open"),
    HEAT_EXCHANGER.signal("hot_flow_kg_s").rename("pack_flow_kg_s"),
)
OUTPUTS = (HEAT_EXCHANGER.signal("hot_out_k").rename("hx_out_k"), HEAT_EXCHANGER.signal("ram_out_k"))
PARAMS = (*DESIGN, _CORE["hx_fouling"])

INSTALLED = PhysicsModel(
    name="installed_exchanger",
    inputs=INPUTS,
    outputs=OUTPUTS,
    params=PARAMS,
    equations=installed_outlets_k,
)
"""Model that the night calibrates (`design`) and tracks (`health`), and that a notebook passes to an `Estimator`."""
