"""Physical terms that an exchanger's model may lack: what a recorded signal is really, with one coefficient each.

The model itself stays as declared. A term says of one of its inputs that the exchanger meets another value than the one
recorded, by `coefficient` times a shape that physics gives. It does nothing until an engineer accepts it by name.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from hdt_core.physics.air import standard_pressure_pa
from hdt_core.physics.model import Array

VAPORISATION_K = 2.5e6 / 1005.0
"""Latent heat of water over specific heat of air: what a kg of vapour in a kg of air cools it by. [K]"""
CABIN_PA, HOT_K = 80e3, 390.0
REVERSAL_ROUNDS = 30


@dataclass(frozen=True, slots=True)
class Term:
    """The exchanger meets ``recorded - coefficient * shape``.

    Attributes
    ----------
    signal : str
        Which recorded signal it concerns.
    shape : callable
        Signals by name -> array (n,), in the signal's unit.
    bounds : tuple
        What a coefficient can be.
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
        Term(
            "water_spray",
            "tat_k",
            _room_for_water_k,
            (-0.5, 1.0),
            "-",
            "share of saturation that water sprayed at the ram inlet reaches",
        ),
        Term(
            "flow_leak",
            "pack_flow_kg_s",
            _leak_kg_s,
            (-0.5, 0.5),
            "-",
            "share of the flow lost between its sensor and the exchanger, at full cabin pressure",
        ),
        Term(
            "inlet_gain",
            "hx_in_k",
            lambda s: s["hx_in_k"] - HOT_K,
            (-0.5, 0.5),
            "K/K",
            "gain error of the hot inlet's sensor",
        ),
        Term(
            "outlet_conduction",
            "hx_out_k",
            lambda s: s["tat_k"] - s["hx_out_k"],
            (-0.5, 0.5),
            "K/K",
            "share by which the hot outlet's probe follows the bay's temperature",
        ),
    )
}
"""The library, by name. Constant errors are sensor biases and what goes as a power of a flow is a film exponent: both
are the calibration's already."""


def corrected(signals: Mapping[str, Array], coefficients: Mapping[str, float]) -> dict[str, Array]:
    """Signals as the exchanger meets them, every term's shape taken from the recorded ones.

    Raises
    ------
    KeyError
        A term that the library does not have.
    """
    met = dict(signals)
    for name, coefficient in coefficients.items():
        term = TERMS[name]
        met[term.signal] = met[term.signal] - coefficient * term.shape(signals)
    return met


def recorded(met: Mapping[str, Array], coefficients: Mapping[str, float]) -> dict[str, Array]:
    """`corrected` turned round, for simulation: what sensors record where the exchanger meets these signals."""
    seen = dict(met)
    for _ in range(REVERSAL_ROUNDS):
        shifts = {TERMS[name]: value * TERMS[name].shape(seen) for name, value in coefficients.items()}
        seen = dict(met)
        for term, shift in shifts.items():
            seen[term.signal] = seen[term.signal] + shift
    return seen


def within(name: str, coefficient: float) -> float:
    """Hold a coefficient within its term's bounds."""
    low, high = TERMS[name].bounds
    return min(max(coefficient, low), high)
