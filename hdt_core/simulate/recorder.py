"""Record true values: biased, noisy, quantised, spiked, stuck and missing, in the recorder's own units."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import polars as pl

from hdt_core.robust import Array

LB_PER_MIN, FOOT, PSI, RPM = 0.45359237 / 60.0, 0.3048, 6894.757293168, np.pi / 30.0


@dataclass(frozen=True, slots=True)
class Sensor:
    """Errors of one sensor in recorded units: spread of bias and noise, whether they are shares of the value, step."""

    bias_sd: float
    noise_sd: float
    relative: bool
    step: float


_T = Sensor(0.5, 0.35, False, 0.25)
SENSORS = {
    "altitude_ft": Sensor(8.0, 5.0, False, 4.0),
    "mach": Sensor(0.001, 0.001, False, 0.001),
    "tat_degc": Sensor(0.4, 0.2, False, 0.25),
    "pt_psia": Sensor(0.001, 0.001, True, 0.01),
    "hx_in_degc": _T,
    "hx_out_degc": _T,
    "ram_door_pct": Sensor(0.8, 0.5, False, 0.5),
    "pack_flow_lbpm": Sensor(0.015, 0.01, True, 0.25),
    "ram_out_degc": _T,
    "cc_speed_rpm": Sensor(0.0005, 0.001, True, 8.0),
    "cc_in_degc": _T,
    "cc_in_psia": Sensor(0.002, 0.003, True, 0.01),
    "cc_out_degc": Sensor(0.6, 0.5, False, 0.25),
    "cc_out_psia": Sensor(0.002, 0.003, True, 0.02),
    "cc_flow_lbpm": Sensor(0.015, 0.02, True, 0.25),
    "vda_pos": Sensor(0.0, 5.0, False, 1.0),
}
Sensors = Mapping[str, Sensor]


@dataclass(frozen=True, slots=True)
class Suite:
    """Sensors of a type of aircraft, and what its recordings hold.

    Attributes
    ----------
    spike_share, lost_share : float
        How often a recorded value is a spike or empty.
    taxi_s : float
        Seconds before take-off that a 1 Hz log begins with.
    least_mach : float
        Mach number reported for a slower aircraft.
    """

    sensors: Sensors
    spike_share: float = 0.001
    lost_share: float = 0.008
    taxi_s: float = 0.0
    least_mach: float = 0.0


CONTRACT = Suite(SENSORS)
_B787: Sensors = SENSORS | {
    "altitude_ft": Sensor(8.0, 0.14, False, 0.02),
    "mach": Sensor(0.001, 0.0005, False, 0.00025),
    "tat_degc": Sensor(0.4, 0.003, False, 0.025),
    "pt_psia": Sensor(0.001, 5e-6, True, 1e-5),
    "hx_in_degc": Sensor(0.5, 0.55, False, 0.025),
    "hx_out_degc": Sensor(0.5, 0.09, False, 0.125),
    "ram_door_pct": Sensor(0.8, 0.002, False, 0.0625),
    "pack_flow_lbpm": Sensor(0.015, 0.0028, True, 0.1),
    "cc_speed_rpm": Sensor(0.0005, 0.0002, True, 1.0),
    "cc_in_degc": Sensor(0.4, 0.003, False, 0.025),
    "cc_in_psia": Sensor(0.002, 0.003, True, 1.0),
    "cc_out_degc": Sensor(0.6, 0.4, False, 0.025),
    "cc_out_psia": Sensor(0.002, 0.0015, True, 0.0125),
    "vda_pos": Sensor(0.0, 1.5, False, 0.6),
}
_A330: Sensors = SENSORS | {
    "altitude_ft": Sensor(8.0, 1.0, False, 4.0),
    "mach": Sensor(0.001, 0.0005, False, 0.004),
    "tat_degc": Sensor(0.4, 0.05, False, 0.25),
    "hx_in_degc": Sensor(0.5, 0.3, False, 0.5),
    "hx_out_degc": Sensor(0.5, 0.32, False, 0.75),
}
SUITES = {
    "contract": CONTRACT,
    "787": Suite(_B787, 1e-5, 0.0, taxi_s=240.0, least_mach=0.1),
    "A330": Suite(_A330, 1e-5, 0.0, taxi_s=240.0, least_mach=0.1),
}
"""Sensors by type of aircraft: the contract's, and two as recordings of seconds show them (noise from one second to the
next and last digit, no spike and no gap in 15,000 values; biases are the contract's, of which one recording says
nothing)."""
AIR_DATA = ("altitude_ft", "mach", "tat_degc", "pt_psia")


def draw_biases(rng: np.random.Generator) -> list[dict[str, float]]:
    """Draw constant errors of one aircraft's sensors, one dict for each of two packs, which share air data."""
    air_biases = {name: SENSORS[name].bias_sd * rng.standard_normal() for name in AIR_DATA}
    return [{n: air_biases.get(n, s.bias_sd * rng.standard_normal()) for n, s in SENSORS.items()} for _ in range(2)]


def record(
    rng: np.random.Generator,
    true: dict[str, Array],
    bias: dict[str, float],
    temperature_step_k: float,
    suite: Suite = CONTRACT,
) -> dict[str, Array]:
    """Record true values (recorded units); NaN where a value is empty.

    Air data must be recorded once for both packs: give them as recorded and leave them out of `true`. A temperature has
    the last digit of the operator, `temperature_step_k`, or where that is 0 its own.
    """
    out = {}
    for name, value in true.items():
        sensor = suite.sensors[name]
        size = np.abs(value) if sensor.relative else 1.0
        reading = value + size * (bias[name] + sensor.noise_sd * rng.standard_normal(value.size))
        spike = rng.random(value.size) < suite.spike_share
        reading = np.where(spike, reading * rng.uniform(0.3, 2.5, value.size), reading)
        step = temperature_step_k if temperature_step_k and name.endswith("degc") else sensor.step
        reading = np.round(reading / step) * step
        out[name] = np.where(rng.random(value.size) < suite.lost_share, np.nan, reading)
    return out


def with_sensor_fault(
    rng: np.random.Generator,
    values: Array,
    *,
    flight: Array,
    faulty: Array,
    kind: str,
    size: float,
) -> Array:
    """Apply a fault of this size, in recorded units, on the flights where `faulty` (per row) holds.

    `kind`: `drift` (reaches `size` in 25 flights and twice that in 50, where it stays), `step`, `stuck` (at the first
    value), and any other leaves seven values in ten out.
    """
    out = values.copy()
    since = flight - flight[faulty].min()
    if kind == "drift":
        out[faulty] += (size * np.minimum(since / 25.0, 2.0))[faulty]
    elif kind == "step":
        out[faulty] += size
    elif kind == "stuck":
        finite = values[faulty & np.isfinite(values)]
        out[faulty] = finite[0] if finite.size else np.nan
    else:
        out[faulty & (rng.random(values.size) < 0.7)] = np.nan
    return out


def frame(columns: dict[str, Array]) -> pl.DataFrame:
    """Build a frame from columns, with NaN as null."""
    return pl.DataFrame(columns).with_columns(pl.selectors.float().fill_nan(None))
