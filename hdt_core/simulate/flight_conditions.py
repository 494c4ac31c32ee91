"""Schedules, flight profiles, weather and season of an aircraft, as conditions at each recorded instant."""

from dataclasses import dataclass, fields

import numpy as np

from hdt_core.physics.air import (
    standard_pressure_pa,
    standard_temperature_k,
    total_to_static_pressure,
    total_to_static_temperature,
)
from hdt_core.robust import Array
from hdt_core.simulate.design import Operator

CLIMB_S, DESCENT_S = 1320.0, 1380.0
TAXI_MACH = 0.02
FAN_MACH = 0.25
"""On the ground a fan draws as much ram air as an aircraft meets at this Mach number; assumed."""
_PHASES = np.array(["TO", "CL", "CR", "DS", "AP"])


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
    flight, times = [], []
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
    cruise_s, top_m = schedule.cruise_s[flight], schedule.cruise_m[flight]
    climb = np.clip(after_s / CLIMB_S, 0.0, 1.0)
    descent = np.clip((after_s - CLIMB_S - cruise_s) / DESCENT_S, 0.0, 1.0)
    # air masses and the autopilot wander along the way: slow waves, so that 1 Hz rows stay smooth
    wave = rng.uniform(0.0, 2.0 * np.pi, schedule.cruise_s.size)[flight]
    altitude_m = top_m * (1.0 - (1.0 - climb) ** 1.6) * (1.0 - descent**1.15) + 3.0 * np.sin(after_s / 140.0 + wave)
    mach = 0.28 + (schedule.cruise_mach[flight] - 0.28) * np.clip(altitude_m / top_m, 0.0, 1.0) ** 0.75
    mach = mach + 0.002 * np.sin(after_s / 310.0 + 2.0 * wave)
    taxies = after_s < 0.0
    altitude_m, mach = np.where(taxies, 0.0, altitude_m), np.where(taxies, TAXI_MACH, mach)
    along_k = 1.5 * np.sin(after_s / 2400.0 + wave) - 1.5 * np.sin(wave)
    static_k = standard_temperature_k(altitude_m) + schedule.warmer_k[flight] + along_k
    return Conditions(
        flight=flight,
        time_s=schedule.departed_s[flight] + after_s,
        phase=np.where(taxies, "GR", _phase(climb, descent)),
        altitude_m=altitude_m,
        mach=mach,
        ram_mach=np.where(taxies, FAN_MACH, mach),
        tat_k=np.asarray(static_k * total_to_static_temperature(mach)),
        total_pressure_pa=np.asarray(standard_pressure_pa(altitude_m) * total_to_static_pressure(mach)),
    )


def _phase(climb: Array, descent: Array) -> Array:
    index = np.select([climb < 0.08, climb < 1.0, descent <= 0.0, descent < 0.85], [0, 1, 2, 3], 4)
    return np.asarray(_PHASES[index])
