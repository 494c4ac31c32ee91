"""Simulate demand on an exchanger: the conductance each flight needs to hold its outlet, in simulated weather.

One fleet is one type of pack with one operator: a design with much or little reserve, a climate with its season, flows
and targets that differ from flight to flight. No wear is in it; a message comes when wear reaches this demand.
"""

from dataclasses import dataclass, replace

import numpy as np

from hdt_core.physics.heat_exchanger import clean_conductance_w_k, outlets_k
from hdt_core.robust import Array
from hdt_core.simulate.design import (
    CLIMB_S,
    Conditions,
    FleetSettings,
    Operator,
    PackDesign,
    Schedule,
    conditions,
    draw_design,
    draw_operators,
    draw_schedule,
)
from hdt_core.simulate.packs import FULL_OPEN, ram_flow_kg_s, sized_target_k
from hdt_core.simulate.signals import hot_inlet_k

LN_RATIOS = np.array([-1.1, -0.7, -0.45, -0.25, -0.1, 0.1, 0.4])
"""Ln conductance ratios at which the outlet is computed. [-]"""
SHARES_OF_FLIGHT = np.array([-0.6, 0.05, 0.3, 0.55, 0.8, 0.98])
"""Samples of a flight, in cruises after top of climb; the first is in the climb above 15,000 ft."""
FIRST_DAYS = 365.0
LEAST_FLOW = 0.6
"""Share of its cruise flow below which a pack is not run. [-]"""
SOUND_HOT = 0.004
"""Share of flights on which sound packs of a type that anyone would fly leave their level by 7 K."""


@dataclass(frozen=True, slots=True)
class Habits:
    """Climate of an operator and its use of the packs, beyond `Operator`.

    Attributes
    ----------
    warmer_k, season_k, weather_k : float
        Air above the standard's, half the range of its year, spread from day to day.
    warmest_day : float
        Day of the year with the warmest air.
    flow_sd, target_sd_k, inlet_sd_k : float
        Standard deviation over flights: of the demanded flow (a share), of the outlet's target, of the hot inlet.
    pack_sd_k : float
        Spread of the target over packs.
    target_slope : float
        How the target follows total air temperature. [K/K]
    low_share : float
        Share of flights too short for the usual cruising levels. [-]
    """

    warmer_k: float
    season_k: float
    weather_k: float
    warmest_day: float
    flow_sd: float
    target_sd_k: float
    inlet_sd_k: float
    pack_sd_k: float
    target_slope: float
    low_share: float


@dataclass(frozen=True, slots=True)
class OutletExcess:
    """Outlet excess of the flights of some packs.

    Attributes
    ----------
    excess_k : ndarray, shape (packs, flights, samples, ratios)
        Outlet with the door full open above its held level, at each of `LN_RATIOS`. [K]
    day : ndarray, shape (packs, flights)
        Days since the first of January of the first year.
    """

    excess_k: Array
    day: Array

    def skip(self, flights: int) -> "OutletExcess":
        """Drop the first flights."""
        return OutletExcess(self.excess_k[:, flights:], self.day[:, flights:])


def draw_habits(rng: np.random.Generator) -> Habits:
    """Draw one operator's habits, over a range wide enough for unknown climates and controllers."""
    u = rng.uniform
    north = rng.random() < 0.85
    return Habits(
        warmer_k=u(-8.0, 18.0),
        season_k=u(0.0, 9.0),
        weather_k=u(1.0, 4.0),
        warmest_day=(200.0 if north else 17.0) + 12.0 * float(rng.standard_normal()),
        flow_sd=u(0.02, 0.09),
        target_sd_k=u(0.3, 3.5),
        inlet_sd_k=u(0.5, 9.0),
        pack_sd_k=u(0.2, 1.2),
        target_slope=u(0.2, 0.7),
        low_share=u(0.0, 0.4),
    )


def excess_at(demand: OutletExcess, ratio: Array) -> Array:
    """Interpolate the outlet's excess at full door at a ln conductance ratio of each flight. (packs, flights, samples)

    Parameters
    ----------
    ratio : array, shape (packs, flights)
    """
    at = np.clip(np.searchsorted(LN_RATIOS, ratio) - 1, 0, LN_RATIOS.size - 2)
    share = ((ratio - LN_RATIOS[at]) / (LN_RATIOS[at + 1] - LN_RATIOS[at]))[:, :, None]
    low, high = (np.take_along_axis(demand.excess_k, (at + n)[:, :, None, None], 3)[..., 0] for n in (0, 1))
    return np.asarray(low + share * (high - low))


def critical_ratio(demand: OutletExcess, share: float, excess_k: float) -> Array:
    """Compute the ln ratio below which `share` of a flight's samples exceed it by `excess_k`. (packs, flights)"""
    curve = np.quantile(demand.excess_k, 1.0 - share, axis=2)
    at = np.clip((curve > excess_k).sum(axis=2) - 1, 0, LN_RATIOS.size - 2)
    high, low = (np.take_along_axis(curve, (at + n)[:, :, None], 2)[..., 0] for n in (0, 1))
    part = (high - excess_k) / np.maximum(high - low, 1e-9)
    return np.asarray(LN_RATIOS[at] + part * (LN_RATIOS[at + 1] - LN_RATIOS[at]))


def draw_demand(rng: np.random.Generator, aircraft: int, flights: int) -> OutletExcess:
    """Draw the demand of a fleet's flights on its packs, two an aircraft with the same conditions.

    Parameters
    ----------
    rng : Generator
        Source of randomness: design, habits and weather are drawn from it.
    aircraft, flights : int
        Size.
    """
    while True:
        demand = _fleet(rng, aircraft, flights)
        if (np.quantile(excess_at(demand, np.zeros(demand.day.shape)), 0.8, axis=2) > 7.0).mean() < SOUND_HOT:
            return demand


def _fleet(rng: np.random.Generator, aircraft: int, flights: int) -> OutletExcess:
    # of any reserve: a clean pack needs from a tenth to most of its ram door in cruise
    design = replace(draw_design(rng), door_sizing=float(rng.uniform(0.12, 0.62)))
    habits = draw_habits(rng)
    operator = draw_operators(rng, FleetSettings(operators=1, tails=1))[0]
    first_day = float(rng.uniform(0.0, FIRST_DAYS))
    parts = [_aircraft(rng, design, operator, habits, flights, first_day) for _ in range(aircraft)]
    return OutletExcess(np.concatenate([p.excess_k for p in parts]), np.concatenate([p.day for p in parts]))


def _aircraft(
    rng: np.random.Generator, design: PackDesign, operator: Operator, habits: Habits, flights: int, first_day: float
) -> OutletExcess:
    schedule = _weather(rng, draw_schedule(rng, operator, flights), habits, first_day)
    flight = np.repeat(np.arange(flights), SHARES_OF_FLIGHT.size)
    share = np.tile(SHARES_OF_FLIGHT, flights)
    after_s = CLIMB_S * np.where(share < 0.0, 1.0 + share, 1.0) + np.maximum(share, 0.0) * schedule.cruise_s[flight]
    now = conditions(rng, schedule, flight, after_s)
    day = np.tile(first_day + schedule.departed_s / 86400.0, (2, 1))
    shape = (2, flights, SHARES_OF_FLIGHT.size, LN_RATIOS.size)
    return OutletExcess(np.stack([_excess_k(rng, design, habits, now) for _ in range(2)]).reshape(shape), day)


def _weather(rng: np.random.Generator, schedule: Schedule, habits: Habits, first_day: float) -> Schedule:
    """Apply the operator's climate to a schedule: season, and weather that stays for some days."""
    day = first_day + schedule.departed_s / 86400.0
    season = habits.season_k * np.cos(2.0 * np.pi * (day - habits.warmest_day) / 365.0)
    lower = rng.random(day.size) < habits.low_share
    cruise_m = np.where(lower, rng.uniform(7300.0, 10100.0, day.size), schedule.cruise_m)
    spell = np.convolve(rng.standard_normal(day.size + 9), np.ones(10) / np.sqrt(10.0), "valid")
    weather = habits.weather_k * (0.6 * spell + 0.8 * heavy_tailed(rng, (day.size,)))
    return replace(schedule, cruise_m=cruise_m, warmer_k=habits.warmer_k + season + weather)


def heavy_tailed(rng: np.random.Generator, size: tuple[int, ...]) -> Array:
    """Draw values of unit variance with the tails of Student's t at five degrees of freedom."""
    return np.asarray(rng.standard_t(5.0, size) / np.sqrt(5.0 / 3.0))


def _excess_k(rng: np.random.Generator, design: PackDesign, habits: Habits, now: Conditions) -> Array:
    """Compute the outlet above its held level with the door full open, at each of `LN_RATIOS`. (samples, ratios)"""
    # now and then a flight is unlike the others: a full cabin, a hot ramp, a failed recirculation fan
    mood = heavy_tailed(rng, (3, int(now.flight.max()) + 1))[:, now.flight]
    height = np.clip(now.altitude_m / 11000.0, 0.0, 1.1)
    flow = design.flow_cruise_kg_s * np.maximum(1.0 + 0.06 * (1.0 - height) + habits.flow_sd * mood[0], LEAST_FLOW)
    hot_in_k = hot_inlet_k(design, now) + habits.inlet_sd_k * mood[1]
    trim_k = habits.pack_sd_k * rng.standard_normal() + habits.target_sd_k * mood[2]
    held_k = sized_target_k(design) + trim_k + habits.target_slope * (now.tat_k - 247.2)
    cold_in_k = now.tat_k + design.ram_heating_k
    ram = ram_flow_kg_s(design, now, np.full_like(flow, FULL_OPEN), np.zeros_like(flow))
    core = ("hx_ua_reference_w_k", "hx_exponent_hot", "hx_exponent_cold", "hx_hot_share", "hx_wall_share")
    clean = clean_conductance_w_k(flow, ram, **{name: np.asarray(getattr(design, name)) for name in core})
    outlets = [outlets_k(flow, ram, hot_in_k, cold_in_k, clean * np.exp(r))[0] for r in LN_RATIOS]
    return np.asarray(np.stack(outlets, axis=1) - held_k[:, None])
