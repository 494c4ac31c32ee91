"""Compute measured over expected conductance of a heat exchanger, and declare its calibration.

Design, priors, bounds and sensors are those of the component's declaration; the ratio inverts it, sample by sample,
with the sensors' biases removed and the ram flow of the clean duct's map.

The calibration is a panel of packs that share a design, each with sensor biases and health: the level of the ratio's
logarithm. That walks with a wide step, so wear in the data isn't taken as normal. The controller opens the door when
the core cools less, so the door depends on health and a plain fit is biased. Flights are therefore compared by
instrumental variables, the weather and the flight level, which move the door and don't depend on it.
"""

from collections.abc import Mapping
from functools import partial

import numpy as np

from hdt_core.calibration.arrays import Points
from hdt_core.components.pack import HX
from hdt_core.estimation.panel import Equation, Panel, Walk, forward_differences
from hdt_core.estimation.problem import Belief
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
HEALTH_STEP = 0.01
"""Random walk of health a flight, wide on purpose: see the module's docstring."""
FLIGHT_SD = 0.02
"""Scatter of a flight's conductance about its health: weather, trim, the map's own error."""
LAW_SD = 0.01
DESIGN_EFFECT, DESIGN_EFFECT_BLIND = 10.0, 40.0
"""Errors of neighbouring points are not independent (season, route, model error): each counts as 1/10. Where no ram
outlet is measured the scale of the ram flow depends on small effects alone, and each counts as 1/40."""
RAM_BALANCE_SD, RAM_DESIGN_EFFECT = 0.015, 10.0
MIN_RAM_POINTS = 20
LN_FLOW_RATIO, LN_FLOW_RATIO_SD = float(np.log(1.5)), 0.15
"""Prior of ram over pack flow in cruise: more costs drag, less can't cool. Matters where no ram outlet is measured."""
MAX_AVERAGED = 6.0
FIRST_LEVEL_SD = 0.3


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
        ln_clean = ln_clean_conductance(s, ram, design)
        ua_w_k = measured_conductance_w_k(s["pack_flow_kg_s"], ram, s["hx_in_k"], s["hx_out_k"], s["tat_k"])
        return np.log(ua_w_k) - ln_clean


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


def exchanger_panel(points: Points, bias_mean: Array, bias_sd: Array) -> Panel:
    """Declare the panel of cruise points.

    Parameters
    ----------
    points : Points
        Level medians, sorted by pack and flight.
    bias_mean, bias_sd : array
        Prior of each pack's sensors, (packs, 6); a pack without points keeps it.

    Returns
    -------
    Panel
        With a second equation, the ram flow by heat balance, where a ram outlet fixes the flow's scale.
    """
    has_ram_outlet = np.isfinite(points.signals["ram_out_k"]).sum() >= MIN_RAM_POINTS
    effect = DESIGN_EFFECT if has_ram_outlet else DESIGN_EFFECT_BLIND
    ram = Equation(partial(ln_ram_flow_ratio, points.signals), RAM_BALANCE_SD, RAM_DESIGN_EFFECT)

    def excess_ram_flow(design: Array) -> Array:
        flow = np.log(clean_ram_flow_kg_s(points.signals, design)) - np.log(points.signals["pack_flow_kg_s"])
        return np.array([(np.nanmedian(flow) - LN_FLOW_RATIO) / LN_FLOW_RATIO_SD])

    noise_sd = NOISE_SDS / np.sqrt(np.minimum(points.n_samples, MAX_AVERAGED))[:, None]
    # samples of a steady flow are all rounded alike
    noise_sd[:, 0] = np.hypot(noise_sd[:, 0], points.flow_step_ln / np.sqrt(12.0))
    return Panel(
        names=NAMES,
        bounds=np.column_stack([LOW, HIGH]),
        prior=Belief(MEAN, np.diag(SD**2)),
        unit_mean=bias_mean,
        unit_sd=bias_sd,
        unit=points.pack,
        time=points.flight,
        levelled=Equation(partial(ln_conductance_ratio, points.signals), LAW_SD, effect),
        walk=Walk(HEALTH_STEP, FLIGHT_SD, FIRST_LEVEL_SD),
        noise_sd=noise_sd,
        step=np.full(len(NAMES), STEP),
        unit_step=STEP_SDS * BIAS_SDS,
        others=(ram,) if has_ram_outlet else (),
        instruments=instruments_of(points.signals),
        prior_terms=excess_ram_flow,
    )


def instruments_of(signals: Mapping[str, Array]) -> Array:
    """Compute instrumental variables of the door: weather, level, speed, and the pack's demand. (n, 8)"""
    base = np.stack(
        [
            np.log(signals["tat_k"] / 255.0),
            np.log(signals["total_pressure_pa"] / 3e4),
            np.log(signals["hx_in_k"] / 400.0),
            np.log(signals["mach"] / 0.83),
            np.log(signals["pack_flow_kg_s"] / 0.8),
        ],
        axis=1,
    )
    return np.asarray(np.nan_to_num(np.c_[base, base[:, :2] ** 2, base[:, 0] * base[:, 1]]))
