"""Physical terms that an exchanger's model may lack: corrections of recorded signals with one coefficient each.

The model itself stays as declared. A term corrects one of its inputs by `coefficient` times a physical shape. It has no
effect until an engineer accepts it by name.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from hdt_core.physics.air import standard_pressure_pa
from hdt_core.physics.model import Array

VAPORISATION_K = 2.5e6 / 1005.0
"""Latent heat of water over specific heat of air: cooling by a kg of vapour in a kg of air. [K]"""
CABIN_PA, HOT_K = 80e3, 390.0
REVERSAL_ROUNDS = 30


@dataclass(frozen=True, slots=True)
class Term:
    """Correction of an input: its actual value is ``recorded - coefficient * shape``.

    Attributes
    ----------
    signal : str
        Recorded signal to correct.
    shape : callable
        Signals by name -> array (n,), in the signal's unit.
    bounds : tuple
        Of the coefficient.
    unit, meaning : str
        Of the coefficient, in words.
    """

    name: str
    signal: str
    shape: Callable[[Mapping[str, Array]], Array]
    bounds: tuple[float, float]
    unit: str
    meaning: str


def saturation_pressure_pa(temperature_k: Array) -> Array:
    """Vapour pressure of water over a plane surface of water. [Pa]

    References
    ----------
    .. [1] O. A. Alduchov and R. E. Eskridge, J. Appl. Meteor. 35, 601, 1996 (Magnus form).

    Examples
    --------
    >>> round(float(saturation_pressure_pa(np.float64(273.15))), 1)
    610.9
    """
    celsius = temperature_k - 273.15
    return 610.94 * np.exp(17.625 * celsius / (celsius + 243.04))


def _room_for_water_k(s: Mapping[str, Array]) -> Array:
    """Cooling of ram air that takes up water until it is saturated, to first order. [K]"""
    vapour_pa = saturation_pressure_pa(np.clip(s["tat_k"], 200.0, 330.0))
    return VAPORISATION_K * 0.622 * vapour_pa / s["total_pressure_pa"]


def _leak_kg_s(s: Mapping[str, Array]) -> Array:
    """Pack flow times the share of cabin pressure that drives it outside. [kg/s]"""
    return s["pack_flow_kg_s"] * (1.0 - standard_pressure_pa(s["altitude_m"]) / CABIN_PA)


TERMS = {
    term.name: term
    for term in (
        Term("water_spray", "tat_k", _room_for_water_k, (-0.5, 1.0), "-",
             "share of saturation that water sprayed at the ram inlet reaches"),
        Term("flow_leak", "pack_flow_kg_s", _leak_kg_s, (-0.5, 0.5), "-",
             "share of the flow lost between its sensor and the exchanger, at full cabin pressure"),
        Term("inlet_gain", "hx_in_k", lambda s: s["hx_in_k"] - HOT_K, (-0.5, 0.5), "K/K",
             "gain error of the hot inlet's sensor"),
        Term("outlet_conduction", "hx_out_k", lambda s: s["tat_k"] - s["hx_out_k"], (-0.5, 0.5), "K/K",
             "share by which the hot outlet's probe follows the bay's temperature"),
    )
}  # fmt: skip
"""The library, by name. Constant errors and powers of a flow are not among them: the calibration has sensor biases and
film exponents."""


def correct_signals(signals: Mapping[str, Array], coefficients: Mapping[str, float]) -> dict[str, Array]:
    """Return the actual signals, with every term's shape taken from the recorded ones.

    Raises
    ------
    KeyError
        Unknown term.
    """
    actual = dict(signals)
    for name, coefficient in coefficients.items():
        term = TERMS[name]
        actual[term.signal] = actual[term.signal] - coefficient * term.shape(signals)
    return actual


def record_signals(actual: Mapping[str, Array], coefficients: Mapping[str, float]) -> dict[str, Array]:
    """Invert `correct_signals` for simulation: return the recorded signals for the actual ones."""
    record = dict(actual)
    for _ in range(REVERSAL_ROUNDS):
        shifts = {TERMS[name]: value * TERMS[name].shape(record) for name, value in coefficients.items()}
        record = dict(actual)
        for term, shift in shifts.items():
            record[term.signal] = record[term.signal] + shift
    return record


def within(name: str, coefficient: float) -> float:
    """Clip a coefficient to its term's bounds."""
    low, high = TERMS[name].bounds
    return min(max(coefficient, low), high)
