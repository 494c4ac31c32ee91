"""How the twin reads a heat exchanger: measured over expected conductance, with the ram flow from the clean duct's map.

Equations are those of `hdt_core.physics`; here they meet sensor errors, the free design parameters and their priors.
"""

from collections.abc import Mapping

import numpy as np

from hdt_core.physics.air import mean_specific_heat_j_kg_k
from hdt_core.physics.heat_exchanger import clean_conductance_w_k, measured_conductance_w_k
from hdt_core.physics.model import Array
from hdt_core.physics.ram_duct import ram_flow

SIGNALS = ("altitude_m", "mach", "tat_k", "total_pressure_pa", "hx_in_k", "hx_out_k", "ram_door_open", "pack_flow_kg_s")

PRIOR: dict[str, tuple[float, float, float, float]] = {
    # name: mean, sd, lowest, highest; ln for what must stay positive
    "ln_ua_reference": (float(np.log(1700.0)), 0.5, 5.0, 9.0),
    "hx_exponent_hot": (0.6, 0.05, 0.3, 0.9),
    "hx_exponent_cold": (0.6, 0.05, 0.3, 0.9),
    "hot_share_logit": (0.0, 0.3, -1.5, 1.5),
    "hx_wall_share": (0.1, 0.05, 0.0, 0.19),
    "film_temperature_exponent": (0.15, 0.15, -0.5, 0.8),
    "ln_door_closed": (float(np.log(0.003)), 0.7, -9.0, -3.0),
    "ln_door_open": (float(np.log(0.04)), 0.4, -5.0, -0.5),
    "ram_door_low": (1.0 / 3.0, 0.15, 0.02, 0.98),
    "ram_door_high": (0.6, 0.25, 0.02, 0.98),
    "ln_rest_area": (float(np.log(0.025)), 0.4, -6.0, -0.5),
    "ram_recovery": (0.8, 0.1, 0.4, 1.0),
}
"""Design knowledge before any flight: offset-strip fins (film exponents), balanced resistances, a duct for 1 to 2
kg/s in cruise."""
NAMES = tuple(PRIOR)
MEAN, SD, LOW, HIGH = (np.array(column) for column in zip(*PRIOR.values(), strict=True))

BIAS_SD = {
    "pack_flow_kg_s": 0.02,
    "hx_in_k": 1.0,
    "hx_out_k": 1.0,
    "tat_k": 0.5,
    "ram_door_open": 0.01,
    "ram_out_k": 1.0,
}
"""Calibration error of each sensor, one draw an installation; of the flow as a fraction."""
NOISE_SD = {
    "pack_flow_kg_s": 0.01,
    "hx_in_k": 0.4,
    "hx_out_k": 0.4,
    "tat_k": 0.3,
    "ram_door_open": 0.006,
    "ram_out_k": 0.4,
}
BIASES = tuple(BIAS_SD)
BIAS_SDS, NOISE_SDS = np.array(list(BIAS_SD.values())), np.array(list(NOISE_SD.values()))

REFERENCE_FILM_K = 325.0


def without_bias(signals: Mapping[str, Array], bias: Array) -> dict[str, Array]:
    """Signals with the sensor biases taken out.

    Parameters
    ----------
    signals : mapping
        `SIGNALS`, and `ram_out_k` where there is one; arrays (n,), SI.
    bias : array
        (6, n) or (6, 1), in the order of `BIASES`.
    """
    clean = dict(signals)
    clean["pack_flow_kg_s"] = signals["pack_flow_kg_s"] * np.exp(-bias[0])
    for row, name in enumerate(BIASES[1:], start=1):
        if name in signals:
            clean[name] = signals[name] - bias[row]
    return clean


def duct_values(design: Array) -> dict[str, Array]:
    """Parameters of `RAM_DUCT` that a design vector stands for, the clean duct's."""
    p = dict(zip(NAMES, design, strict=True))
    # core and exit can't be told apart from a cruise: one resistance stands for both
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
    """Parameters of `HEAT_EXCHANGER` that a design vector stands for, the clean core's."""
    p = dict(zip(NAMES, design, strict=True))
    return {
        "hx_ua_reference_w_k": np.exp(p["ln_ua_reference"]),
        "hx_exponent_hot": p["hx_exponent_hot"],
        "hx_exponent_cold": p["hx_exponent_cold"],
        "hx_hot_share": (1.0 - p["hx_wall_share"]) / (1.0 + np.exp(-p["hot_share_logit"])),
        "hx_wall_share": p["hx_wall_share"],
    }


def clean_ram_flow_kg_s(signals: Mapping[str, Array], design: Array) -> Array:
    """Ram flow of a clean core at this door position. (n,) [kg/s]"""
    inputs = {n: signals[n] for n in ("total_pressure_pa", "tat_k", "altitude_m", "mach")}
    door = np.clip(signals["ram_door_open"], 0.0, 1.0)
    return ram_flow(**inputs, ram_door_open=door, **duct_values(design), ram_flow_loss=np.zeros(1))


def ln_clean_conductance(signals: Mapping[str, Array], ram_flow_kg_s: Array, design: Array) -> Array:
    """Logarithm of the UA that the digital system model expects, in W/K. (n,)"""
    clean = clean_conductance_w_k(signals["pack_flow_kg_s"], ram_flow_kg_s, **core_values(design))
    film_k = 0.5 * (signals["hx_in_k"] + signals["tat_k"])
    exponent = design[NAMES.index("film_temperature_exponent")]
    return np.asarray(np.log(clean) + exponent * np.log(film_k / REFERENCE_FILM_K))


def ln_conductance_ratio(signals: Mapping[str, Array], design: Array, bias: Array) -> Array:
    """Logarithm of measured over expected UA: unit offset minus wear, in the mean. (n,) NaN where no exchanger fits."""
    s = without_bias(signals, bias)
    ram = clean_ram_flow_kg_s(s, design)
    with np.errstate(divide="ignore", invalid="ignore"):  # a shut door or a pack at rest has no exchanger to fit
        measured = measured_conductance_w_k(s["pack_flow_kg_s"], ram, s["hx_in_k"], s["hx_out_k"], s["tat_k"])
        return np.log(measured) - ln_clean_conductance(s, ram, design)


def ln_ram_flow_ratio(signals: Mapping[str, Array], design: Array, bias: Array) -> Array:
    """Logarithm of the ram flow that the heat balance shows, with `ram_out_k`, over that of the clean map. (n,)"""
    s = without_bias(signals, bias)
    with np.errstate(divide="ignore", invalid="ignore"):
        hot_j_kg = mean_specific_heat_j_kg_k(s["hx_in_k"], s["hx_out_k"]) * (s["hx_in_k"] - s["hx_out_k"])
        ram_j_kg = mean_specific_heat_j_kg_k(s["tat_k"], s["ram_out_k"]) * (s["ram_out_k"] - s["tat_k"])
        balance = s["pack_flow_kg_s"] * hot_j_kg / ram_j_kg
        return np.log(balance) - np.log(clean_ram_flow_kg_s(s, design))
