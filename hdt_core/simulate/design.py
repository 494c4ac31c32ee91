"""Design and operation of a simulated fleet: packs and operators, drawn once per seed so that no two fleets share their
constants; schedules, flight profiles, weather and season, as conditions at each recorded instant."""

import string
from dataclasses import dataclass, field, fields

import numpy as np

from hdt_core.physics.air import (
    standard_pressure_pa,
    standard_temperature_k,
    total_to_static_pressure,
    total_to_static_temperature,
)
from hdt_core.robust import Array
from hdt_core.simulate.wear import WearSettings

CABIN_SENSORS = ("ram_out_degc", "cc_out_degc")
CLIMB_S, DESCENT_S = 1320.0, 1380.0
TAXI_MACH = 0.02
FAN_MACH = 0.25
"""On the ground a fan draws as much ram air as an aircraft meets at this Mach number; assumed."""
_PHASES = np.array(["TO", "CL", "CR", "DS", "AP"])


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


@dataclass(frozen=True, slots=True)
class Schedule:
    """Flights of one aircraft, one entry each.

    Attributes
    ----------
    departed_s : ndarray
        Seconds since the first day's midnight UTC.
    cruise_s, cruise_m, cruise_mach, warmer_k : ndarray
        Length, pressure altitude and Mach number of the cruise; air above the standard's temperature.
    """

    departed_s: Array
    cruise_s: Array
    cruise_m: Array
    cruise_mach: Array
    warmer_k: Array


@dataclass(frozen=True, slots=True)
class Conditions:
    """Outside conditions at recorded instants, one entry each; SI.

    `ram_mach` is what the ram duct meets: the flight's Mach number, on the ground the fan's.
    """

    flight: Array
    time_s: Array
    phase: Array
    altitude_m: Array
    mach: Array
    ram_mach: Array
    tat_k: Array
    total_pressure_pa: Array

    def at(self, index: Array) -> "Conditions":
        """Return the conditions at some of the instants."""
        return Conditions(*(getattr(self, f.name)[index] for f in fields(self)))

    @property
    def cruise(self) -> Array:
        """Instants in level cruise."""
        return np.asarray(self.phase == "CR")


def draw_schedule(rng: np.random.Generator, operator: Operator, flights: int) -> Schedule:
    """Draw legs with turnarounds between them and nights at the base."""
    per_day = np.clip(rng.poisson(operator.legs_per_day, flights), 1, 6)
    day = np.repeat(np.arange(flights), per_day)[:flights]
    cruise_s = 3600.0 * np.clip(operator.sector_hours * np.exp(0.35 * rng.standard_normal(flights)), 0.4, 3.2)
    # 24 h shared by at most six legs, so that a day's legs stay in order
    gap_s = np.minimum(cruise_s + CLIMB_S + DESCENT_S + 2700.0, 86400.0 / (per_day[day] + 0.5))
    start_s = 86400.0 * day + rng.uniform(3.5, 7.0, flights)[day] * 3600.0
    elapsed_s = np.cumsum(gap_s) - gap_s
    departed_s = start_s + elapsed_s - elapsed_s[np.searchsorted(day, day)]
    season = 5.0 * np.sin(2.0 * np.pi * (departed_s / 86400.0 - 30.0) / 365.0)
    weather = np.convolve(rng.standard_normal(flights + 9), np.ones(10) / np.sqrt(10.0), "valid")
    return Schedule(
        departed_s=np.round(departed_s),
        cruise_s=np.minimum(cruise_s, gap_s - CLIMB_S - DESCENT_S - 900.0),
        cruise_m=304.8 * rng.choice([33.0, 35, 36, 37, 38, 39], flights),
        cruise_mach=np.clip(0.835 + 0.012 * rng.standard_normal(flights), 0.78, 0.87),
        warmer_k=operator.warmer_k + season + 2.0 * weather + 2.5 * rng.standard_normal(flights),
    )


def snapshot_times(rng: np.random.Generator, schedule: Schedule) -> tuple[Array, Array]:
    """Draw flight and seconds after departure of each snapshot: dense in climb and descent."""
    flight = []
    times = []
    for number, cruise_s in enumerate(schedule.cruise_s):
        climb = CLIMB_S * (np.arange(8) + rng.uniform(0.2, 0.8, 8)) / 8.0
        level = CLIMB_S + np.cumsum(rng.uniform(180.0, 600.0, int(cruise_s // 180.0) + 1))
        descent = CLIMB_S + cruise_s + DESCENT_S * (np.arange(7) + rng.uniform(0.2, 0.8, 7)) / 7.0
        at = np.concatenate([climb, level[level < CLIMB_S + cruise_s], descent])
        flight.append(np.full(at.size, number))
        times.append(np.round(at))
    return np.concatenate(flight), np.concatenate(times)


def conditions(rng: np.random.Generator, schedule: Schedule, flight: Array, after_s: Array) -> Conditions:
    """Compute altitude, Mach number, temperature and pressure at instants of flights, each flight in order of time.

    Before 0 s the aircraft taxies.
    """
    cruise_s = schedule.cruise_s[flight]
    top_m = schedule.cruise_m[flight]
    climb = np.clip(after_s / CLIMB_S, 0.0, 1.0)
    descent = np.clip((after_s - CLIMB_S - cruise_s) / DESCENT_S, 0.0, 1.0)
    # air masses and the autopilot wander along the way: slow waves, so that 1 Hz rows stay smooth
    wave = rng.uniform(0.0, 2.0 * np.pi, schedule.cruise_s.size)[flight]
    altitude_m = top_m * (1.0 - (1.0 - climb) ** 1.6) * (1.0 - descent**1.15) + 3.0 * np.sin(after_s / 140.0 + wave)
    mach = 0.28 + (schedule.cruise_mach[flight] - 0.28) * np.clip(altitude_m / top_m, 0.0, 1.0) ** 0.75
    mach = mach + 0.002 * np.sin(after_s / 310.0 + 2.0 * wave)
    taxies = after_s < 0.0
    altitude_m = np.where(taxies, 0.0, altitude_m)
    mach = np.where(taxies, TAXI_MACH, mach)
    phase = np.select([climb < 0.08, climb < 1.0, descent <= 0.0, descent < 0.85], [0, 1, 2, 3], 4)
    along_k = 1.5 * np.sin(after_s / 2400.0 + wave) - 1.5 * np.sin(wave)
    static_k = standard_temperature_k(altitude_m) + schedule.warmer_k[flight] + along_k
    return Conditions(
        flight=flight,
        time_s=schedule.departed_s[flight] + after_s,
        phase=np.where(taxies, "GR", _PHASES[phase]),
        altitude_m=altitude_m,
        mach=mach,
        ram_mach=np.where(taxies, FAN_MACH, mach),
        tat_k=np.asarray(static_k * total_to_static_temperature(mach)),
        total_pressure_pa=np.asarray(standard_pressure_pa(altitude_m) * total_to_static_pressure(mach)),
    )
