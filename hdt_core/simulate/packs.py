"""Simulate a pack at given conditions: compressor, ram duct, worn exchanger and the controller of the ram door.

Richer than the estimators' model: wear is a film of fixed resistance, a blockage that starves the ram flow, or lost
area; film coefficients follow temperature; ram air is warmed on its way; the controller moves the door to hold the
outlet.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hdt_core.physics.air import R_J_KG_K, total_to_static_pressure
from hdt_core.physics.compressor import HEAD, exit_temperature_k
from hdt_core.physics.heat_exchanger import clean_conductance_w_k, measured_conductance_w_k, outlets_k
from hdt_core.physics.installed_exchanger import ram_flow
from hdt_core.robust import Array
from hdt_core.simulate.design import Conditions, PackDesign

FULL_OPEN = 1.0
_FILM_K = 330.0
_STEPS = 12
_CORE = ("hx_exponent_hot", "hx_exponent_cold", "hx_hot_share", "hx_wall_share")
_DUCT = (
    "ram_area_closed_m2", "ram_area_open_m2", "ram_door_low", "ram_door_high", "ram_exit_area_m2", "ram_recovery"
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class ExchangerWear:
    """State of an exchanger: film resistance [K/W], blockage and lost area [-], unit's own conductance ratio [-]."""

    film_k_w: Array
    blockage: Array
    area_loss: Array
    unit_ua: Array

    def at(self, index: Array) -> "ExchangerWear":
        """Return the wear of some of the flights."""
        return ExchangerWear(self.film_k_w[index], self.blockage[index], self.area_loss[index], self.unit_ua[index])


@dataclass(frozen=True, slots=True)
class Demand:
    """Demand of controller and cabin: flow [kg/s], hot inlet [K], target of the hot outlet [K]."""

    flow_kg_s: Array
    hot_in_k: Array
    target_k: Array

    def at(self, index: Array) -> "Demand":
        """Return the demand at some of the instants."""
        return Demand(self.flow_kg_s[index], self.hot_in_k[index], self.target_k[index])


def clean(like: Array) -> ExchangerWear:
    """Return the state of a nominal new exchanger."""
    zero = np.zeros_like(like)
    return ExchangerWear(zero, zero, zero, zero + 1.0)


def ram_flow_kg_s(design: PackDesign, now: Conditions, door: Array, blockage: Array) -> Array:
    """Flow through the duct when the core's free area is what blockage leaves. [kg/s]"""
    return np.asarray(
        ram_flow(
            ram_door_open=door,
            total_pressure_pa=now.total_pressure_pa * _fan_pressure_ratio(now),
            tat_k=now.tat_k,
            altitude_m=now.altitude_m,
            mach=now.ram_mach,
            ram_core_area_m2=design.ram_core_area_m2 * (1.0 - blockage),
            ram_flow_loss=np.zeros(1),
            **_values(design, _DUCT),
        )
    )


def _fan_pressure_ratio(now: Conditions) -> Array:
    """Compute the fan's total pressure ratio; exactly 1 where it does not run."""
    by_fan = total_to_static_pressure(now.ram_mach) / total_to_static_pressure(now.mach)
    return np.where(now.ram_mach > now.mach, by_fan, 1.0)


def conductance_w_k(
    design: PackDesign, demand: Demand, flow_kg_s: Array, cold_in_k: Array, wear: ExchangerWear
) -> Array:
    """Compute UA of the worn exchanger at these flows and temperatures. [W/K]"""
    clean_w_k = clean_conductance_w_k(
        demand.flow_kg_s,
        flow_kg_s,
        hx_ua_reference_w_k=design.hx_ua_reference_w_k * wear.unit_ua,
        **_values(design, _CORE),
    )
    # k^0.67 mu^-0.27 of air is about T^0.3; the wall's share keeps it from acting in full
    warm = (0.25 * (demand.hot_in_k + demand.target_k + 2.0 * cold_in_k) / _FILM_K) ** 0.25
    area_share = (1.0 - wear.area_loss) * (1.0 - 0.5 * wear.blockage)
    return np.asarray(1.0 / (1.0 / (clean_w_k * warm * area_share) + wear.film_k_w))


def outlets(
    design: PackDesign, now: Conditions, demand: Demand, door: Array, wear: ExchangerWear
) -> tuple[Array, Array, Array, Array]:
    """Compute hot outlet [K], ram outlet [K], ram flow [kg/s] and UA [W/K] at a door position."""
    flow = ram_flow_kg_s(design, now, door, wear.blockage)
    cold_in_k = now.tat_k + design.ram_heating_k
    ua = conductance_w_k(design, demand, flow, cold_in_k, wear)
    hot_out_k, ram_out_k = outlets_k(demand.flow_kg_s, flow, demand.hot_in_k, cold_in_k, ua)
    return np.asarray(hot_out_k), np.asarray(ram_out_k), flow, ua


def controlled_door(design: PackDesign, now: Conditions, demand: Demand, wear: ExchangerWear) -> Array:
    """Return the door position that holds the outlet at its target, or the nearer stop where none does."""
    low = np.full_like(now.mach, design.door_least)
    high = np.full_like(now.mach, FULL_OPEN)
    return bisect_door(lambda door: outlets(design, now, demand, door, wear)[0] > demand.target_k, low, high)


def bisect_door(too_hot: Callable[[Array], Array], low: Array, high: Array, steps: int = _STEPS) -> Array:
    """Bisect for the door position between two stops from which on the outlet is no longer too hot."""
    for _ in range(steps):
        door = 0.5 * (low + high)
        hot = too_hot(door)
        low = np.where(hot, door, low)
        high = np.where(hot, high, door)
    return 0.5 * (low + high)


def target_k(now: Conditions, demand_k: Array) -> Array:
    """Compute the controller's outlet target: warmer with the air outside, plus the cabin's demand. [K]"""
    return demand_k + 0.45 * (now.tat_k - 250.0)


def sized_target_k(design: PackDesign) -> float:
    """Compute the target at 250 K outside for which a clean pack cruises with its door at `door_sizing`. [K]"""
    ones = np.ones(1)
    now = reference(ones)
    demand = reference_demand(design, ones)
    return float(outlets(design, now, demand, ones * design.door_sizing, clean(ones))[0][0])


def reference(ones: Array) -> Conditions:
    """Return the reference cruise of conductance ratios: 37,000 ft, Mach 0.84, standard day."""
    return Conditions(
        flight=ones.astype(int), time_s=ones, phase=np.full(ones.shape, "CR"), altitude_m=11277.6 * ones,
        mach=0.84 * ones, ram_mach=0.84 * ones,
        tat_k=247.2 * ones, total_pressure_pa=34380.0 * ones,
    )  # fmt: skip


def reference_demand(design: PackDesign, ones: Array) -> Demand:
    """Return flow and temperatures of the reference cruise."""
    return Demand(design.flow_cruise_kg_s * ones, (360.0 + design.hot_rise_k) * ones, 297.0 * ones)


def loss_ratios(design: PackDesign, wear: ExchangerWear) -> tuple[Array, Array, Array]:
    """Compute true and apparent conductance over the clean unit's, and ram flow over the clean core's. [-]

    At the reference cruise and door; *apparent* assumes the clean core's ram flow.
    """
    ones = np.ones_like(wear.blockage)
    now = reference(ones)
    demand = reference_demand(design, ones)
    door = ones * design.door_sizing
    clean_wear = ExchangerWear(0.0 * ones, 0.0 * ones, 0.0 * ones, wear.unit_ua)
    hot_k, _, flow, ua = outlets(design, now, demand, door, wear)
    clean_hot_k, _, clean_flow, clean_ua = outlets(design, now, demand, door, clean_wear)
    cold_k = now.tat_k + design.ram_heating_k
    apparent_ua = measured_conductance_w_k(demand.flow_kg_s, clean_flow, demand.hot_in_k, hot_k, cold_k)
    apparent_clean_ua = measured_conductance_w_k(demand.flow_kg_s, clean_flow, demand.hot_in_k, clean_hot_k, cold_k)
    return ua / clean_ua, np.asarray(apparent_ua / apparent_clean_ua), flow / clean_flow


def compressor_rows(
    *, diameter_m: Array, inlet_k: Array, inlet_pa: Array, exit_pa: Array, efficiency: Array
) -> tuple[Array, Array]:
    """Compute the speed [rad/s] for a pressure rise by effective diameter (equation 5), and exit temperature [K]."""
    ratio = exit_pa / inlet_pa
    head = np.maximum(ratio**HEAD - 1.0, 1e-4) * R_J_KG_K * inlet_k / HEAD
    return 2.0 / diameter_m * np.sqrt(head), np.asarray(exit_temperature_k(inlet_k, ratio, efficiency))


def compressor_pressures_pa(now: Conditions) -> tuple[Array, Array]:
    """Compute pressures before and behind the compressor: recovered outside air, and the cabin's demand. [Pa]"""
    inlet_pa = 0.965 * now.total_pressure_pa
    return inlet_pa, np.maximum(1000.0 * (113.0 - 20.5 * np.clip(now.altitude_m / 11300.0, 0.0, 1.1)), 1.08 * inlet_pa)


def behind_worn_compressor(design: PackDesign, now: Conditions, demand: Demand, loss: Array) -> Demand:
    """Add the heat of a compressor's efficiency loss to the demand on the exchanger."""
    inlet_pa, exit_pa = compressor_pressures_pa(now)
    eta = np.full(loss.size, design.cc_efficiency)
    sound_k, worn_k = (exit_temperature_k(now.tat_k, exit_pa / inlet_pa, e) for e in (eta, eta * (1.0 - loss)))
    return replace(demand, hot_in_k=demand.hot_in_k + worn_k - sound_k)


def _values(design: PackDesign, names: tuple[str, ...]) -> dict[str, Array]:
    return {name: np.asarray(getattr(design, name)) for name in names}
