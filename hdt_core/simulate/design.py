"""Design and operation of a simulated fleet, drawn once per seed so that no two fleets share their constants."""

import string
from dataclasses import dataclass, field

import numpy as np

from hdt_core.simulate.wear import WearSettings

CABIN_SENSORS = ("ram_out_degc", "cc_out_degc")


@dataclass(frozen=True, slots=True)
class FleetSettings:
    """Size of a fleet.

    Attributes
    ----------
    operators, tails, flights : int
        Operators, aircraft of each, flights of each aircraft.
    first_day : str
        ISO date of the first departures.
    cpl_share : float
        Share of flights that leave a 1 Hz log as well. [-]
    missing : dict
        Coefficient of each physical term that the twin's model lacks (`hdt_core.physics.terms`), by name.
    suite : str
        Sensors of the type of aircraft, a name of `hdt_core.simulate.recorder.SUITES`.
    """

    operators: int = 2
    tails: int = 4
    flights: int = 350
    first_day: str = "2024-03-04"
    cpl_share: float = 0.004
    missing: dict[str, float] = field(default_factory=dict)
    suite: str = "contract"


@dataclass(frozen=True, slots=True)
class PackDesign:
    """As-built constants of a pack; names and units as in the declared models, K and kg/s elsewhere."""

    hx_ua_reference_w_k: float
    hx_exponent_hot: float
    hx_exponent_cold: float
    hx_hot_share: float
    hx_wall_share: float
    hx_core_heat_j_k: float
    ram_area_closed_m2: float
    ram_area_open_m2: float
    ram_door_low: float
    ram_door_high: float
    ram_core_area_m2: float
    ram_exit_area_m2: float
    ram_recovery: float
    ram_heating_k: float
    door_sizing: float
    door_least: float
    unmet_limit_k: float
    hot_rise_k: float
    flow_cruise_kg_s: float
    diameter_intercept_m: float
    diameter_slope_m_per_count: float
    diameter_scatter_m: float
    cc_efficiency: float


@dataclass(frozen=True, slots=True)
class Operator:
    """Climate, network and habits of an operator, and columns that its recorder leaves out."""

    name: str
    tails: tuple[str, ...]
    warmer_k: float
    dust: float
    legs_per_day: float
    sector_hours: float
    temperature_step_k: float
    ram_out_share: float
    missing: tuple[str, ...]
    wrong_phase_share: float
    wash_every: int
    wear: WearSettings


def draw_design(rng: np.random.Generator) -> PackDesign:
    """Draw the constants of one type of pack, within what physics and drawings allow."""
    u = rng.uniform
    return PackDesign(
        hx_ua_reference_w_k=float(1900.0 * np.exp(0.15 * rng.standard_normal())),
        hx_exponent_hot=u(0.5, 0.72),
        hx_exponent_cold=u(0.5, 0.72),
        hx_hot_share=u(0.38, 0.55),
        hx_wall_share=u(0.02, 0.08),
        hx_core_heat_j_k=u(13e3, 27e3),
        ram_area_closed_m2=u(0.002, 0.005),
        ram_area_open_m2=u(0.05, 0.08),
        ram_door_low=u(0.15, 0.45),
        ram_door_high=u(0.35, 0.65),
        ram_core_area_m2=u(0.03, 0.05),
        ram_exit_area_m2=u(0.04, 0.07),
        ram_recovery=u(0.82, 0.95),
        ram_heating_k=u(0.0, 2.0),
        door_sizing=u(0.20, 0.30),
        door_least=u(0.06, 0.12),
        unmet_limit_k=u(9.0, 14.0),
        hot_rise_k=u(38.0, 52.0),
        flow_cruise_kg_s=u(0.72, 0.85),
        diameter_intercept_m=0.1731 + 0.002 * rng.standard_normal(),
        diameter_slope_m_per_count=-2.9304e-5 * u(0.9, 1.1),
        diameter_scatter_m=u(0.004, 0.007),
        cc_efficiency=u(0.72, 0.79),
    )


def draw_operators(rng: np.random.Generator, settings: FleetSettings) -> tuple[Operator, ...]:
    """Draw operators with their own climate, network, recorder and habits."""
    return tuple(_draw_operator(rng, number, settings) for number in range(settings.operators))


def _draw_operator(rng: np.random.Generator, number: int, settings: FleetSettings) -> Operator:
    letters = string.ascii_uppercase
    name = "S" + letters[number // 26 % 26] + letters[number % 26]
    dust = float(rng.choice([0.3, 1.0, 2.0]))
    wear = WearSettings(
        life_median_flights=float(330.0 / dust**0.35 * np.exp(0.15 * rng.standard_normal())),
        shape_shares=(0.22, 0.15, 0.13, 0.30, 0.20 * dust),
        clog_rate=dust / 3000.0,
    )
    return Operator(
        name=name,
        tails=tuple(f"{name[1:]}-{k:04d}" for k in range(settings.tails)),
        warmer_k=rng.uniform(-6.0, 14.0),
        dust=dust,
        legs_per_day=rng.uniform(2.5, 4.5),
        sector_hours=rng.uniform(1.2, 3.5),
        temperature_step_k=float(rng.choice([0.1, 0.25, 0.5])),
        ram_out_share=float(rng.choice([0.0, 0.5, 1.0])),
        missing=tuple(c for c in CABIN_SENSORS if rng.random() < 0.3),
        wrong_phase_share=rng.uniform(0.0, 0.06),
        wash_every=int(rng.choice([0, 180, 300])),
        wear=wear,
    )
