"""The air that margins are stated for: a reference cruise on the standard day, and the hot day."""

import numpy as np

from hdt_core.physics.air import (
    standard_pressure_pa,
    standard_temperature_k,
    total_to_static_pressure,
    total_to_static_temperature,
)
from hdt_core.physics.model import Array

REFERENCE_M, REFERENCE_MACH = 11_000.0, 0.84
HIGH_CRUISE_M = 12_497.0
"""41,000 ft, the highest usual cruise level: thin air demands most of a compressor. [m]"""
HOT_DAY_K = 15.0
"""The hot day that a margin is stated for: the standard atmosphere and 15 K, at the flight's level, speed and flow."""


def reference_air(n: int, level_m: float = REFERENCE_M) -> dict[str, Array]:
    """Return `altitude_m, mach, tat_k, total_pressure_pa` of the reference cruise, or of another level, (n,) each."""
    altitude_m, mach = np.full(n, level_m), np.full(n, REFERENCE_MACH)
    return {
        "altitude_m": altitude_m,
        "mach": mach,
        "tat_k": standard_temperature_k(altitude_m) * total_to_static_temperature(mach),
        "total_pressure_pa": standard_pressure_pa(altitude_m) * total_to_static_pressure(mach),
    }


def hot_day_tat_k(altitude_m: Array, mach: Array) -> Array:
    """Compute total air temperature of the hot day. [K]"""
    return np.asarray((standard_temperature_k(altitude_m) + HOT_DAY_K) * total_to_static_temperature(mach))
