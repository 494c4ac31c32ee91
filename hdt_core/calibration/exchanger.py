"""Compute measured over expected conductance of a heat exchanger, with the ram flow of the clean duct's map.

Design, priors, bounds and sensors are those of the component's declaration; this module inverts it, sample by
sample, with the sensors' biases removed.
"""

from collections.abc import Mapping

import numpy as np

from hdt_core.components.exchanger import HX
from hdt_core.estimation.panel import forward_differences
from hdt_core.flight.legs import MODEL_SIGNALS
from hdt_core.physics.heat_exchanger import mean_specific_heat_j_kg_k, measured_conductance_w_k
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s, ln_clean_conductance
from hdt_core.physics.model import Array, declared

SIGNALS = MODEL_SIGNALS
_DESIGN = HX.model.free("design")
NAMES = tuple(p.name for p in _DESIGN)
MEAN, SD = np.array([p.nominal for p in _DESIGN]), np.array([declared(p.sd) for p in _DESIGN])
LOW, HIGH = HX.model.bounds("design").T
STEP, STEP_SDS = 1e-4, 0.01
"""Of derivatives: of a design parameter, and of a sensor's bias in its standard deviations."""

BIASES = ("pack_flow_kg_s", "hx_in_k", "hx_out_k", "tat_k", "ram_door_open", "ram_out_k")
_SENSORS = [HX.model.signal(name) for name in BIASES]
BIAS_SD = {s.name: declared(s.gain_sd if s.bias_sd is None else s.bias_sd) for s in _SENSORS}
"""Calibration error of each sensor, one draw an installation; of the flow as a fraction."""
NOISE_SD = {s.name: declared(s.sigma) for s in _SENSORS}
"""Of the flow too as a fraction: packs take about 1 kg/s."""
BIAS_SDS, NOISE_SDS = np.array(list(BIAS_SD.values())), np.array(list(NOISE_SD.values()))


def without_bias(signals: Mapping[str, Array], bias: Array) -> dict[str, Array]:
    """Remove the sensor biases from signals.

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


def ln_conductance_ratio(signals: Mapping[str, Array], design: Array, bias: Array) -> Array:
    """Compute ln of measured over expected UA: unit offset minus wear, in the mean. (n,) NaN without a solution."""
    s = without_bias(signals, bias)
    ram = clean_ram_flow_kg_s(s, design)
    with np.errstate(divide="ignore", invalid="ignore"):  # a shut door or a pack at rest has no exchanger to fit
        ua_w_k = measured_conductance_w_k(s["pack_flow_kg_s"], ram, s["hx_in_k"], s["hx_out_k"], s["tat_k"])
        return np.log(ua_w_k) - ln_clean_conductance(s, ram, design)


def design_gradient(signals: Mapping[str, Array], design: Array, bias: Array, ratio: Array) -> Array:
    """Compute the derivative of `ln_conductance_ratio`, whose values are `ratio`, by each design parameter. (n, p)"""
    step = np.full(len(design), STEP)
    return forward_differences(lambda d: ln_conductance_ratio(signals, d, bias), design, ratio, step, HIGH)


def ln_ram_flow_ratio(signals: Mapping[str, Array], design: Array, bias: Array) -> Array:
    """Compute ln of the ram flow by heat balance, with `ram_out_k`, over that of the clean map. (n,)"""
    s = without_bias(signals, bias)
    with np.errstate(divide="ignore", invalid="ignore"):
        hot_j_kg = mean_specific_heat_j_kg_k(s["hx_in_k"], s["hx_out_k"]) * (s["hx_in_k"] - s["hx_out_k"])
        ram_j_kg = mean_specific_heat_j_kg_k(s["tat_k"], s["ram_out_k"]) * (s["ram_out_k"] - s["tat_k"])
        balance = s["pack_flow_kg_s"] * hot_j_kg / ram_j_kg
        return np.log(balance) - np.log(clean_ram_flow_kg_s(s, design))
