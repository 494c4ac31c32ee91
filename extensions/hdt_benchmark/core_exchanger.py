"""Heat exchanger at 1 Hz: the cross-flow exchanger in steady state, and a core that stores heat in between.

A wall of one temperature between two streams would have the same ceiling as the paper's equations (7)-(8). Here only
the *departure* of the core from its steady temperature is lumped: the steady answer stays exact, and heat is conserved.
"""

from typing import Any, NamedTuple

import numpy as np

from hdt_core.physics.heat_exchanger import (
    INPUTS,
    OUTPUTS,
    PARAMS,
    REFERENCE_HOT_FLOW_KG_S,
    REFERENCE_RAM_FLOW_KG_S,
    capacity_rates,
    film_gains,
    film_resistance,
    steady_exchanger,
)
from hdt_core.physics.model import Array, Param, PhysicsModel, State


class Core(NamedTuple):
    """Outlets of the steady exchanger, corrected for a core off its steady temperature.

    `hot_gain`, `cold_gain` are the degrees by which an outlet moves for each degree of the core, [-]; `settling_s` is
    the time constant of the core. [s]
    """

    hot_out_k: Array
    ram_out_k: Array
    steady_k: Array
    hot_gain: Array
    cold_gain: Array
    settling_s: Array


def core(
    *,
    hot_flow_kg_s: Array,
    ram_flow_kg_s: Array,
    hot_in_k: Array,
    cold_in_k: Array,
    hx_core_heat_j_k: Array,
    hx_ua_reference_w_k: Array,
    hx_exponent_hot: Array,
    hx_exponent_cold: Array,
    hx_hot_share: Array,
    hx_wall_share: Array,
    hx_fouling: Array,
) -> Core:
    r"""Steady outlets, steady core temperature, gains and time constant; arguments as declared in `CORE_EXCHANGER`.

    Notes
    -----
    A core warmer by :math:`\delta` all over warms an outlet by :math:`(1 - e^{-N_i}) \delta`, with :math:`N_i` the
    film's own transfer units; the heat for it is the core's:

    .. math:: C \dot\delta = -\left[W_h c (1 - e^{-N_h}) + W_c c (1 - e^{-N_c})\right] \delta

    The steady core temperature is taken from the mean of each stream and the drop across its film.

    References
    ----------
    .. [1] S. Shah, G. Liu, D. R. Greatrix, AIAA 2009-5282: the capacity of both streams is nothing beside the core's.
    """
    hot_out_k, ram_out_k = steady_exchanger(
        hot_flow_kg_s=hot_flow_kg_s,
        ram_flow_kg_s=ram_flow_kg_s,
        hot_in_k=hot_in_k,
        cold_in_k=cold_in_k,
        hx_ua_reference_w_k=hx_ua_reference_w_k,
        hx_exponent_hot=hx_exponent_hot,
        hx_exponent_cold=hx_exponent_cold,
        hx_hot_share=hx_hot_share,
        hx_wall_share=hx_wall_share,
        hx_fouling=hx_fouling,
    )
    hot_rate_w_k, ratio = capacity_rates(hot_flow_kg_s, ram_flow_kg_s, hot_in_k, hot_out_k, cold_in_k)
    cold_rate_w_k = hot_rate_w_k / ratio
    hot_share = hot_flow_kg_s / REFERENCE_HOT_FLOW_KG_S
    cold_share = ram_flow_kg_s / REFERENCE_RAM_FLOW_KG_S
    gains = film_gains(hot_in_k, cold_in_k)
    rest = 1.0 - hx_hot_share - hx_wall_share
    hot_film_w_k = hx_ua_reference_w_k / film_resistance(hot_share, hx_hot_share, hx_exponent_hot, gains[0])
    cold_film_w_k = hx_ua_reference_w_k / film_resistance(cold_share, rest, hx_exponent_cold, gains[1])
    heat_w = hot_rate_w_k * (hot_in_k - hot_out_k)
    under_hot_k = 0.5 * (hot_in_k + hot_out_k) - heat_w / hot_film_w_k
    over_cold_k = 0.5 * (cold_in_k + ram_out_k) + heat_w / cold_film_w_k
    hot_gain = -np.expm1(-hot_film_w_k / hot_rate_w_k)
    cold_gain = -np.expm1(-cold_film_w_k / cold_rate_w_k)
    settling_s = hx_core_heat_j_k / (hot_rate_w_k * hot_gain + cold_rate_w_k * cold_gain)
    return Core(hot_out_k, ram_out_k, 0.5 * (under_hot_k + over_cold_k), hot_gain, cold_gain, settling_s)


def _outlets_k(*, core_k: Array, **values: Any) -> tuple[Array, Array]:
    now = core(**values)
    off_k = core_k - now.steady_k
    return now.hot_out_k + now.hot_gain * off_k, now.ram_out_k + now.cold_gain * off_k


def _rate_k_s(*, core_k: Array, **values: Any) -> Array:
    now = core(**values)
    return (now.steady_k - core_k) / now.settling_s


def _step_k(*, core_k: Array, dt_s: float, **values: Any) -> Array:
    """Exact while the inputs are held, at any step."""
    now = core(**values)
    return now.steady_k + (core_k - now.steady_k) * np.exp(-dt_s / now.settling_s)


_PARAMS = (Param("hx_core_heat_j_k", "J/K", 18e3, (2e3, 100e3), "design"), *PARAMS)

CORE_EXCHANGER = PhysicsModel(
    name="heat_exchanger",
    inputs=INPUTS,
    outputs=OUTPUTS,
    params=_PARAMS,
    states=(State("core_k", "K", 300.0),),
    equations=_outlets_k,
    rates=_rate_k_s,
    step=_step_k,
)
"""For 1 Hz logs. 15 to 30 kg of aluminium settle in 3 to 10 s."""
