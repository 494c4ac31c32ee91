"""Files of an aircraft's ground station: recorded values, messages, maintenance log; and the truth of lives and faults.

True values are biased, noisy, quantised, spiked, stuck and missing, in the recorder's own units.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from typing import Any

import numpy as np
import polars as pl

from hdt_core.robust import Array
from hdt_core.simulate.design import Operator, PackDesign, Schedule
from hdt_core.simulate.unit_histories import PackHistory

LB_PER_MIN, FOOT, PSI, RPM = 0.45359237 / 60.0, 0.3048, 6894.757293168, np.pi / 30.0
ONSET_LOSS = 0.05
_TEXTS = {"21-52-HXTEMP": "PACK TEMPERATURE HIGH", "21-51-CCFLOW": "CAC FLOW LOW", "21-61-TRIM": "TRIM AIR VALVE"}

MESSAGES: dict[str, Any] = {
    "message_time": pl.Datetime("us", "UTC"), "flight_id": pl.String, "pack": pl.Int32, "code": pl.String,
    "text": pl.String,
}  # fmt: skip
MAINTENANCE: dict[str, Any] = {
    "done_on": pl.Date, "pack": pl.Int32, "component": pl.String, "action": pl.String, "finding": pl.String,
    "reference": pl.String,
}  # fmt: skip
EVENTS: dict[str, Any] = {
    "operator": pl.String, "tail": pl.String, "pack": pl.Int64, "component": pl.String, "kind": pl.String,
    "finding": pl.String, "removal_kind": pl.String, "censored": pl.Boolean, "installed_index": pl.Int64,
    "onset_index": pl.Int64, "onset_flight_id": pl.String, "message_index": pl.Int64, "message_flight_id": pl.String,
    "removal_index": pl.Int64, "removal_flight_id": pl.String,
}  # fmt: skip


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


@dataclass(frozen=True, slots=True)
class Plan:
    """Properties that both packs of one aircraft share."""

    operator: Operator
    design: PackDesign
    tail: str
    schedule: Schedule
    ids: Array
    start: datetime
    biases: list[dict[str, float]]
    has_ram_out: bool
    suite: Suite = CONTRACT


def flight_ids(tail: str, start: datetime, departed_s: Array) -> Array:
    """Return flight ids: tail, date of departure, leg of that day."""
    days = [(start + timedelta(seconds=float(s))).strftime("%Y%m%d") for s in departed_s]
    legs = pl.DataFrame({"day": days}).select(pl.int_range(1, pl.len() + 1).over("day")).to_series()
    return np.array([f"{tail}_{day}_{leg:02d}" for day, leg in zip(days, legs, strict=True)])


def fleet_row(rng: np.random.Generator, operator: Operator, tail: str) -> pl.DataFrame:
    """Draw the row of fleet.csv."""
    delivered_on = date(int(rng.integers(2012, 2023)), 6, 1)
    serial_number = int(rng.integers(30000, 60000))
    row = {"operator": operator.name, "tail": tail, "msn": serial_number, "delivered_on": delivered_on, "packs": 2}
    return pl.DataFrame(row)


class LogWriter:
    """Messages, log entries and events of one aircraft, pack by pack."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._messages: list[dict[str, Any]] = []
        self._maintenance: list[dict[str, Any]] = []
        self._events: list[dict[str, Any]] = []

    def write(self, rng: np.random.Generator, history: PackHistory, pack: int, health: pl.DataFrame) -> None:
        """Add one pack's history."""
        loss = 1.0 - np.minimum(health["ua_ratio"].to_numpy(), health["apparent_ua_ratio"].to_numpy())
        for message in history.messages:
            after_s = rng.uniform(2400.0, 3600.0)
            moment = self._departure(message["index"]) + timedelta(seconds=float(np.round(after_s)))
            row = {"message_time": moment, "flight_id": self._id(message["index"]), "pack": pack}
            self._messages.append(row | {"code": message["code"], "text": _TEXTS[message["code"]]})
        for entry in history.maintenance:
            row = {"done_on": self._departure(entry["index"]).date(), "pack": pack} | entry
            self._maintenance.append(row | {"reference": f"WO{rng.integers(10**6, 10**7)}"})
        for event in history.events:
            self._events.append(self._event_row(event, pack, {"HX": loss, "CC": history.cc_loss}))

    def message_frame(self) -> pl.DataFrame:
        """Return rows of messages.csv in order of time, without repeats."""
        return (
            _table(self._messages, MESSAGES)
            .unique(["flight_id", "pack", "code"], keep="first", maintain_order=True)
            .sort("message_time", "pack")
        )

    def maintenance_frame(self) -> pl.DataFrame:
        """Return rows of maintenance.csv in order of date."""
        return _table(self._maintenance, MAINTENANCE).sort("done_on", "pack", "reference")

    def event_frame(self) -> pl.DataFrame:
        """Return the truth: one row a life or fault."""
        return _table(self._events, EVENTS)

    def _event_row(self, event: dict[str, Any], pack: int, loss: dict[str, Array]) -> dict[str, Any]:
        row: dict[str, Any] = {"operator": self._plan.operator.name, "tail": self._plan.tail, "pack": pack} | event
        if event["component"] in loss:
            first = event["installed_index"]
            last = event["removal_index"] or self._plan.ids.size
            onsets = np.nonzero(loss[event["component"]][first:last] > ONSET_LOSS)[0]
            row["onset_index"] = first + int(onsets[0]) if onsets.size else None
        for name in ("onset", "message", "removal"):
            index = row.get(f"{name}_index")
            row[f"{name}_flight_id"] = None if index is None else self._id(index)
        return row

    def _id(self, index: int) -> str:
        return str(self._plan.ids[index])

    def _departure(self, index: int) -> datetime:
        return self._plan.start + timedelta(seconds=float(self._plan.schedule.departed_s[index]))


def _table(rows: list[dict[str, Any]], schema: dict[str, Any]) -> pl.DataFrame:
    return pl.DataFrame([{name: row.get(name) for name in schema} for row in rows], schema=schema, orient="row")
