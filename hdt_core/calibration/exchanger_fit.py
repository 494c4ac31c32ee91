"""Declare the exchanger's calibration: a panel of packs that share a design, each with sensor biases and health.

The residual is the logarithm of measured over expected conductance, its level the pack's health. That walks with a wide
step, so wear in the data isn't taken as normal. The controller opens the door when the core cools less, so the door
depends on health and a plain fit is biased. Flights are therefore compared by instrumental variables, the weather and
the flight level, which move the door and don't depend on it.
"""

from collections.abc import Mapping
from functools import partial

import numpy as np

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import Array, Points
from hdt_core.estimation.panel import Equation, Panel, Walk
from hdt_core.estimation.problem import Belief
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s

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
    ram = Equation(partial(hx.ln_ram_flow_ratio, points.signals), RAM_BALANCE_SD, RAM_DESIGN_EFFECT)

    def excess_ram_flow(design: Array) -> Array:
        flow = np.log(clean_ram_flow_kg_s(points.signals, design)) - np.log(points.signals["pack_flow_kg_s"])
        return np.array([(np.nanmedian(flow) - LN_FLOW_RATIO) / LN_FLOW_RATIO_SD])

    return Panel(
        names=hx.NAMES,
        bounds=np.column_stack([hx.LOW, hx.HIGH]),
        prior=Belief(hx.MEAN, np.diag(hx.SD**2)),
        unit_mean=bias_mean,
        unit_sd=bias_sd,
        unit=points.pack,
        time=points.flight,
        levelled=Equation(partial(hx.ln_conductance_ratio, points.signals), LAW_SD, effect),
        walk=Walk(HEALTH_STEP, FLIGHT_SD, FIRST_LEVEL_SD),
        noise_sd=hx.NOISE_SDS / np.sqrt(np.minimum(points.n_samples, MAX_AVERAGED))[:, None],
        step=np.full(len(hx.NAMES), hx.STEP),
        unit_step=hx.STEP_SDS * hx.BIAS_SDS,
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
