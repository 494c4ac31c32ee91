"""Declare what physics demands of the columns of one row, whatever the weather and the wear: numbers within limits.

The limits are those of working aircraft with a margin. On two simulated fleets (660,000 rows: hot and cold, worn
and clogged, packs off, sensors dead, drifting and spiking) each law holds in more than 99 % of the rows.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hdt_core.physics.air import standard_pressure_pa, total_to_static_pressure
from hdt_core.physics.compressor import area_diameter_tan_beta_m3, effective_diameter_m, isentropic_efficiency
from hdt_core.physics.model import Array
from pipelines.intake.columns import PSI_PA

Signals = Mapping[str, Array]
"""SI name: values, NaN where missing."""
MIN_PRESSURE_RATIO = 1.25
"""Pressure ratio above which a compressor is surely at work."""
MIN_FLOW_KG_S = 0.04
"""Flow below which a pack is off."""


@dataclass(frozen=True, slots=True)
class Law:
    """One demand; its value is NaN where a row lacks a signal."""

    name: str
    value: Callable[[Signals], Array]
    low: float
    high: float


def _difference(one: str, other: str) -> Callable[[Signals], Array]:
    return lambda s: s[one] - s[other]


def _ratio(one: str, other: str) -> Callable[[Signals], Array]:
    return lambda s: s[one] / s[other]


def _at_work(s: Signals, value: Array) -> Array:
    return np.where(s["cc_out_pa"] > MIN_PRESSURE_RATIO * s["cc_in_pa"], value, np.nan)


def _diameter_m(s: Signals) -> Array:
    return _at_work(s, effective_diameter_m(s["cc_in_pa"], s["cc_out_pa"], s["cc_in_k"], s["cc_speed_rad_s"]))


def _efficiency(s: Signals) -> Array:
    return _at_work(s, isentropic_efficiency(s["cc_in_pa"], s["cc_out_pa"], s["cc_in_k"], s["cc_out_k"]))


def _group_m3(flow: str) -> Callable[[Signals], Array]:
    return lambda s: _at_work(s, area_diameter_tan_beta_m3(s[flow], s["cc_in_pa"], s["cc_in_k"], s["cc_speed_rad_s"]))


def _flow_ratio(s: Signals) -> Array:
    both = (s["pack_flow_kg_s"] > MIN_FLOW_KG_S) & (s["cc_flow_kg_s"] > MIN_FLOW_KG_S)
    return np.where(both, s["pack_flow_kg_s"] / s["cc_flow_kg_s"], np.nan)


def _ram_effectiveness(s: Signals) -> Array:
    """Ram air's temperature rise over the difference of the inlet temperatures. [-]"""
    difference = s["hx_in_k"] - s["tat_k"]
    return np.where(difference > 40.0, (s["ram_out_k"] - s["tat_k"]) / difference, np.nan)


def pressure_over_atmosphere(s: Signals) -> Array:
    """Total pressure over that of the standard atmosphere at the altitude and Mach number. [-]"""
    static = standard_pressure_pa(np.clip(s["altitude_m"], -1000.0, 20000.0))
    return s["total_pressure_pa"] / (static * total_to_static_pressure(np.clip(s["mach"], 0.0, 1.0)))


HIGHEST = {
    "tat_k": 423.15, "cc_in_k": 423.15, "hx_out_k": 493.15, "ram_out_k": 493.15, "hx_in_k": 563.15, "cc_out_k": 533.15,
    "total_pressure_pa": 23.5 * PSI_PA, "cc_in_pa": 23.5 * PSI_PA, "cc_out_pa": 75.0 * PSI_PA,
}  # fmt: skip
"""Limits that no air in the pack reaches: outside it stays below 80 °C, behind the exchanger below 200 °C, its total
pressure below 23.5 psia; in kelvin and, up to 45,000 ft, in kPa it reads above that."""


def _of(signal: str) -> Callable[[Signals], Array]:
    return lambda s: s[signal]


LAWS = (
    Law("the exchanger cools", _difference("hx_in_k", "hx_out_k"), -5.0, 160.0),
    Law("the compressor heats", _difference("cc_out_k", "cc_in_k"), -8.0, 215.0),
    Law("the compressor compresses", _ratio("cc_out_pa", "cc_in_pa"), 0.93, 4.6),
    Law("the compressor's inlet has the temperature outside", _difference("tat_k", "cc_in_k"), -6.5, 6.5),
    Law("the compressor's inlet has the pressure outside", _ratio("cc_in_pa", "total_pressure_pa"), 0.8, 1.08),
    Law("altitude, Mach and pressure are of one atmosphere", pressure_over_atmosphere, 0.9, 1.1),
    Law("an airliner stays below the speed of sound", _of("mach"), -0.1, 1.2),
    Law("a pressure ratio needs a speed", _diameter_m, 0.115, 0.205),
    Law("a temperature rise needs a pressure ratio", _efficiency, 0.5, 0.88),
    Law("a speed moves a volume of air", _group_m3("cc_flow_kg_s"), 5.8e-4, 1.3e-3),
    Law("a speed moves a volume of air into the pack", _group_m3("pack_flow_kg_s"), 5.6e-4, 1.3e-3),
    Law("what enters the compressor leaves the pack", _flow_ratio, 0.75, 1.33),
    Law("the exchanger's inlet is near the compressor's exit", _difference("hx_in_k", "cc_out_k"), -10.0, 88.0),
    Law("the exchanger's inlet is bleed air", _of("hx_in_k"), 293.0, 461.0),
    Law("the exchanger's exit is near the air outside", _difference("hx_out_k", "tat_k"), -30.0, 80.0),
    Law("ram air stays colder than bleed air", _difference("hx_in_k", "ram_out_k"), -5.0, 160.0),
    Law("ram air is heated part of the way", _ram_effectiveness, 0.15, 0.85),
    Law("a door is never shut in flight", _of("ram_door_open"), 0.015, 1.1),
    *(
        Law(f"{signal} is below what any air of a pack reaches", _of(signal), -np.inf, high)
        for signal, high in HIGHEST.items()
    ),
)


def law_values(signals: Signals) -> Array:
    """Evaluate each law in each row; NaN where a signal is missing. (laws, rows)"""
    with np.errstate(all="ignore"):
        return np.stack([law.value(signals) for law in LAWS])


def violations(values: Array) -> NDArray[np.bool_]:
    """Return whether values of `law_values` violate their law. (laws, rows)"""
    low, high = (np.array([[getattr(law, side)] for law in LAWS]) for side in ("low", "high"))
    return (values < low) | (values > high)
