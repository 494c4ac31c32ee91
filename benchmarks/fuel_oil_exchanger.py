"""A fuel-oil exchanger as a stranger declares it, and fleets of sister units simulated with a finer physics.

The declaration has one conductance and constant specific heats; the true one follows both flows (films in series) and
the specific heats the temperatures. A unit's truth is known: its size as made, its loss at every flight.
"""

import numpy as np

from hdt_core.components import Channel, Component, Limit, Record
from hdt_core.physics.effectiveness import counterflow_effectiveness
from hdt_core.physics.model import Array, Param, PhysicsModel, Signal, declared

OIL_J_KG_K, FUEL_J_KG_K = 2000.0, 2100.0
LIFE_FLIGHTS, LIMIT = 300.0, Limit(0.35, 0.05, 0.03)
NOISE_K, OUTLET_NOISE_K, BIAS_SD_K = 0.3, 0.5, 1.0
SAMPLES = 8
"""Samples of a flight."""


def declared_outlets_k(
    *, oil_kg_s: Array, oil_in_k: Array, fuel_kg_s: Array, fuel_in_k: Array, foh_ua_w_k: Array, foh_loss: Array
) -> tuple[Array, Array]:
    """Compute both outlets of a counterflow exchanger of one conductance, of which fouling takes a share. [K]"""
    hot = oil_kg_s * OIL_J_KG_K
    cold = fuel_kg_s * FUEL_J_KG_K
    return _outlets_k(oil_in_k, fuel_in_k, hot, cold, (1.0 - foh_loss) * foh_ua_w_k)


def _outlets_k(oil_in_k: Array, fuel_in_k: Array, hot: Array, cold: Array, ua_w_k: Array) -> tuple[Array, Array]:
    least = np.minimum(hot, cold)
    share = counterflow_effectiveness(ua_w_k / least, least / np.maximum(hot, cold))
    heat_w = share * least * (oil_in_k - fuel_in_k)
    return oil_in_k - heat_w / hot, fuel_in_k + heat_w / cold


def true_outlets_k(
    oil_kg_s: Array, oil_in_k: Array, fuel_kg_s: Array, fuel_in_k: Array, ua_w_k: Array
) -> tuple[Array, Array]:
    """Compute both outlets with films that follow the flows and specific heats that follow the temperatures. [K]"""
    resistance = 0.55 * (oil_kg_s / 0.5) ** -0.6 + 0.45 * (fuel_kg_s / 0.6) ** -0.8
    oil_out_k = oil_in_k - 20.0
    fuel_out_k = fuel_in_k + 15.0
    for _ in range(4):
        hot = oil_kg_s * OIL_J_KG_K * (1.0 + 0.0018 * (0.5 * (oil_in_k + oil_out_k) - 355.0))
        cold = fuel_kg_s * FUEL_J_KG_K * (1.0 + 0.002 * (0.5 * (fuel_in_k + fuel_out_k) - 305.0))
        oil_out_k, fuel_out_k = _outlets_k(oil_in_k, fuel_in_k, hot, cold, ua_w_k / resistance)
    return oil_out_k, fuel_out_k


INPUTS = (
    Signal("oil_kg_s", "kg/s", sigma=0.005),
    Signal("oil_in_k", "K", sigma=NOISE_K, bias_sd=BIAS_SD_K),
    Signal("fuel_kg_s", "kg/s", sigma=0.006),
    Signal("fuel_in_k", "K", sigma=NOISE_K, bias_sd=BIAS_SD_K),
)
OUTPUTS = tuple(Signal(name, "K", sigma=OUTLET_NOISE_K, bias_sd=BIAS_SD_K) for name in ("oil_out_k", "fuel_out_k"))
UA = Param("foh_ua_w_k", "W/K", 900.0, (200.0, 3000.0), "design")
LOSS = Param("foh_loss", "-", 0.0, (-0.5, 0.9), "health", drift=0.002)
EXCHANGER = Component(
    code="FOH",
    name="fuel-oil exchanger",
    lost="UA lost",
    model=PhysicsModel("fuel_oil_exchanger", INPUTS, OUTPUTS, (UA, LOSS), declared_outlets_k),
    loss="foh_loss",
    limit=LIMIT,
    life_flights=LIFE_FLIGHTS,
    action="Wash it",
    message_code="79-21-OILTEMP",
    new_share=0.7,
    record=Record(tuple(Channel(s.name, s.name, s.unit, s.name) for s in (*INPUTS, *OUTPUTS))),
)


def measured(rng: np.random.Generator, loss: Array, size_w_k: Array, bias_k: Array) -> dict[str, Array]:
    """Simulate one position's record, (flights, SAMPLES), its oil outlet's sensor off by `bias_k`, (flights, 1)."""
    shape = (len(loss), SAMPLES)

    def flown(mean: float, between: float, within: float) -> Array:
        return mean + between * rng.standard_normal((len(loss), 1)) + within * rng.standard_normal(shape)

    oil_kg_s = flown(0.5, 0.04, 0.01)
    fuel_kg_s = flown(0.6, 0.06, 0.012)
    oil_in_k = flown(360.0, 6.0, 0.5)
    fuel_in_k = flown(300.0, 6.0, 0.5)
    ua_w_k = (size_w_k * (1.0 - loss))[:, None]
    oil_out_k, fuel_out_k = true_outlets_k(oil_kg_s, oil_in_k, fuel_kg_s, fuel_in_k, ua_w_k)
    true = (oil_kg_s, oil_in_k, fuel_kg_s, fuel_in_k, oil_out_k + bias_k, fuel_out_k)
    signals = zip((*INPUTS, *OUTPUTS), true, strict=True)
    return {s.name: values + declared(s.sigma) * rng.standard_normal(shape) for s, values in signals}
