r"""A ram-cooled exchanger without flow sensors, from its two hot temperatures, air data and airspeed.

Many aircraft record neither pack flow nor ram door. What is left is the effectiveness, and that the aircraft's motion
drives ram air through the core.
"""

import numpy as np

from hdt_core.physics.air import density_kg_m3, total_to_static_pressure, total_to_static_temperature
from hdt_core.physics.model import Array, Param, PhysicsModel, Signal
from hdt_core.physics.terms import TERMS

REFERENCE_FLUX_KG_S_M2 = 100.0
"""About that of 150 kt at 3,000 ft. [kg/s/m2]"""
SPEED_OF_SOUND_M_S_K = float(np.sqrt(1.4 * 287.05287))
SPRAY = Param("hxt_water_spray", "-", 0.3, (-0.2, 1.0), "design", sd=0.2)
NTU = Param("hxt_ntu", "-", 1.6, (0.3, 8.0), "design", sd=0.4)
EXPONENT = Param("hxt_exponent", "-", 0.27, (0.0, 1.0), "design", sd=0.05)
"""Film exponent of 0.6 times the cold side's share of the resistance."""
LOSS = Param("hxt_loss", "-", 0.0, (-1.0, 0.95), "health", drift=0.01)


def ram_flux_kg_s_m2(mach: Array, total_pressure_pa: Array, tat_k: Array) -> Array:
    """Mass flux of outside air past the aircraft. [kg/s/m2]

    Examples
    --------
    >>> round(float(ram_flux_kg_s_m2(np.float64(0.24), np.float64(94e3), np.float64(293.15))), 1)
    88.9
    """
    static_k = tat_k / total_to_static_temperature(mach)
    density = density_kg_m3(total_pressure_pa / total_to_static_pressure(mach), static_k)
    return np.asarray(density * mach * SPEED_OF_SOUND_M_S_K * np.sqrt(static_k))


def effectiveness(hot_in_k: Array, hot_out_k: Array, tat_k: Array) -> Array:
    """Share of the way to the outside's total temperature that the hot air is cooled. [-]

    Above one where the core meets colder air than the probe in the nose: by water sprayed into the ram duct, above all.
    """
    return np.asarray((hot_in_k - hot_out_k) / (hot_in_k - tat_k))


def hot_out_k(
    *,
    hot_in_k: Array,
    tat_k: Array,
    total_pressure_pa: Array,
    ram_flux_kg_s_m2: Array,
    hxt_ntu: Array,
    hxt_exponent: Array,
    hxt_loss: Array,
) -> Array:
    r"""Hot outlet with flows by the airspeed alone. [K]

    Notes
    -----
    .. math:: \varepsilon = 1 - \exp(-(1 - s)\, N (G / 100)^{n})

    with ram flux :math:`G`, transfer units :math:`N` at 100 kg/s/m2 and loss :math:`s`. Of a cross-flow exchanger this
    is the limit of much ram air; what less does is in :math:`n`.
    """
    return _outlet(hot_in_k, tat_k, ram_flux_kg_s_m2, (hxt_ntu, hxt_exponent, hxt_loss))


def sprayed_hot_out_k(
    *,
    hot_in_k: Array,
    tat_k: Array,
    total_pressure_pa: Array,
    ram_flux_kg_s_m2: Array,
    hxt_ntu: Array,
    hxt_exponent: Array,
    hxt_water_spray: Array,
    hxt_loss: Array,
) -> Array:
    """`hot_out_k` with the ram air cooled by the term `water_spray`. [K]"""
    room_k = TERMS["water_spray"].shape({"tat_k": tat_k, "total_pressure_pa": total_pressure_pa})
    return _outlet(hot_in_k, tat_k - hxt_water_spray * room_k, ram_flux_kg_s_m2, (hxt_ntu, hxt_exponent, hxt_loss))


def _outlet(hot_in_k: Array, sink_k: Array, flux: Array, core: tuple[Array, Array, Array]) -> Array:
    ntu, exponent, loss = core
    remainder = np.exp(-(1.0 - loss) * ntu * (flux / REFERENCE_FLUX_KG_S_M2) ** exponent)
    return np.asarray(sink_k + remainder * (hot_in_k - sink_k))


_INPUTS = (
    Signal("hot_in_k", "K"),
    Signal("tat_k", "K"),
    Signal("total_pressure_pa", "Pa"),
    Signal("ram_flux_kg_s_m2", "kg/s/m2"),
)
_OUTPUTS = (Signal("hot_out_k", "K", sigma=3.0),)
"""A sensor's 1 K; of samples a second apart each counts a tenth."""
UNMETERED = PhysicsModel("unmetered_exchanger", _INPUTS, _OUTPUTS, (NTU, EXPONENT, LOSS), hot_out_k)
SPRAYED = PhysicsModel(
    "unmetered_exchanger_sprayed", _INPUTS, _OUTPUTS, (NTU, EXPONENT, SPRAY, LOSS), sprayed_hot_out_k
)
