"""Correct the conductance ratio for sensor faults that redundant sensors confirm.

Redundant are the compressor's inlet flow for pack flow, the compressors' inlet temperatures for TAT, the other pack's
exit temperature, at a constant distance while both doors can move, climb and descent for the door's position, and for
the hot inlet what discharge, ram outlet and both flows make of it. If
a difference leaves its usual level, and the conductance with it as that sensor's error would make it, the error is
corrected. With a confirming second difference no such step is needed, so a slow drift can be corrected too: climb and
descent have no other reason to differ from the cruise, and TAT differs from both packs' compressor inlets alike.
"""

from math import copysign, isfinite, isnan, nan, sqrt
from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.flight.cross_checks import INLET_SHARE, TOLERANCE
from hdt_core.records.keys import join_other_pack, split_packs


class RedundantSensor(NamedTuple):
    """A sensor with a redundant one.

    Columns of their difference, of the ln conductance ratio's derivative by it (empty: 1), and of a confirming
    difference (empty: none); threshold of the difference, memory [flight], flights in a row that must depart one
    way, the part of the sensor's error that the difference shows, and whether the sensor is sound if it is quiet.
    """

    difference: str
    slope: str
    threshold: float
    confirmation: str = ""
    memory: float = 40.0
    n_confirm: int = 2
    share: float = 1.0
    vouches: bool = True


LONG = 200.0
"""Memory with a confirming difference: a drift within that time is detected. Good sensors keep their level to a third
of their flight-to-flight scatter over years."""
REDUNDANT_SENSORS = (
    # a door that reads wrong moves the ratio of cruise, and that of climb and descent by twice as much
    # it confirms itself: a few samples of climb may err for a flight or two, but not for ten one way
    RedundantSensor("door_apart_ln", "", 0.04, "door_apart_ln", LONG, n_confirm=10),
    RedundantSensor("exit_apart_k", "ratio_per_exit_k", TOLERANCE["outlet_between_packs_k"]),
    RedundantSensor("flows_apart_ln", "ratio_per_ln_flow", TOLERANCE["pack_over_compressor_flow_ln"]),
    # a blockage, a door or a flow that reads wrong move it too, but the conductance against it
    # an error below its threshold moves the conductance by up to a tenth, so it vouches for nothing
    RedundantSensor("inlet_apart_k", "ratio_per_inlet_k", TOLERANCE["inlet_apart_k"], share=INLET_SHARE, vouches=False),
    RedundantSensor("tat_apart_k", "ratio_per_tat_k", TOLERANCE["inlet_minus_tat_k"], "other_tat_apart_k", LONG),
)
GATE_SD = 4.0
RATIO_MEMORY, SHIFT_MEMORY = 6.0, 8.0
MIN_CONFIRM, LEAST_USUAL = 2, 5
SHARE_LOW, SHARE_HIGH = 0.4, 2.0
SHIFT_SD = 0.15
"""Part of a correction that may be wrong."""
CORRECTED = "sensor_corrected"
"""Status of a loss of which a sensor's error was taken out; the flight's own estimate has it still."""
N_SENSORS = 5
"""Sensors whose errors move the conductance ratio: hot inlet and outlet, pack flow, TAT, door position."""


class Corrections(NamedTuple):
    """For each row: ln ratio to subtract, its variance, whether a sensor is at fault, and the share of the ratio's
    sensors that no quiet difference vouches for. (n,)"""

    shift: Array
    variance: Array
    fault: Array
    unchecked: Array


def corrections(flights: pl.DataFrame) -> Corrections:
    """Estimate what sensor faults add to the ln conductance ratio of each row, from it and earlier rows, in order."""
    n = flights.height
    total = Corrections(np.zeros(n), np.zeros(n), np.zeros(n, dtype=bool), np.ones(n))
    table = join_other_pack(flights, ["tat_apart_k"] if "tat_apart_k" in flights.columns else [])
    ratio = table["ln_ua_ratio"].to_numpy().astype(float)
    for sensor in REDUNDANT_SENSORS:
        if sensor.difference not in table.columns:
            continue
        difference = table[sensor.difference].to_numpy().astype(float)
        slope = table[sensor.slope].to_numpy().astype(float) if sensor.slope else np.ones(n)
        slope = slope / sensor.share
        column = sensor.confirmation
        confirmation = table[column].to_numpy().astype(float) if column else np.full(n, np.nan)
        for rows in split_packs(flights):
            series = (values[rows].tolist() for values in (difference, slope, ratio - total.shift, confirmation))
            shift, is_quiet = map(np.array, _follow_difference(sensor, *series))
            total.unchecked[rows] -= is_quiet * sensor.vouches / N_SENSORS
            total.shift[rows] += shift
            total.variance[rows] += (SHIFT_SD * shift) ** 2
            total.fault[rows] |= shift != 0.0
    return total


def _follow_difference(
    sensor: RedundantSensor, difference: list[float], slope: list[float], ratio: list[float], confirmation: list[float]
) -> tuple[list[float], list[bool]]:
    """Follow one difference along a pack; return the correction of each flight, from it and earlier ones, and whether
    the difference is at its usual level.

    Plain numbers: one by one they take a third of the time of NumPy's.
    """
    shift = [0.0] * len(difference)
    is_quiet = [False] * len(difference)
    usual = 0.0
    last = 0.0
    sd = sensor.threshold / GATE_SD
    n_usual = 0
    confirmation_mean = 0.0
    n_confirmation = 0
    ratio_mean = nan
    n_off = 0
    n_back = 2
    sign = 0.0
    fault = False
    level = 0.0
    second = 0.0
    n_second = 0
    for k in range(len(difference)):
        deviation = difference[k] - usual
        if isfinite(deviation):
            if n_usual >= LEAST_USUAL and abs(deviation) > max(sensor.threshold, GATE_SD * sd):
                n_off = n_off + 1 if copysign(1.0, deviation) == sign else 1
                sign = copysign(1.0, deviation)
                n_back = 0
                level = deviation if n_off == 1 else level + (deviation - level) / min(n_off, SHIFT_MEMORY)
                if isfinite(confirmation[k]):
                    n_second = n_second + 1 if n_off > 1 else 1
                    second += (confirmation[k] - confirmation_mean - second) / min(n_second, SHIFT_MEMORY)
                if not fault and n_off >= sensor.n_confirm:
                    has_second = min(n_confirmation, n_second) >= MIN_CONFIRM
                    change = ratio[k] - ratio_mean
                    fault = _explains(level, second) if has_second else _explains(slope[k] * level, change)
            else:
                n_back += 1
                if n_back >= MIN_CONFIRM or not fault:
                    n_off = 0
                    fault = False
                n_usual += 1
                gain = 1.0 / min(n_usual, sensor.memory)
                # of steps from flight to flight: a drift must not pass for scatter
                sd += gain * (1.25 * abs(difference[k] - last) / sqrt(2.0) - sd) if n_usual > 1 else 0.0
                usual = usual + gain * deviation
                last = difference[k]
                if isfinite(confirmation[k]):
                    n_confirmation += 1
                    confirmation_mean += (confirmation[k] - confirmation_mean) / min(n_confirmation, sensor.memory)
        is_quiet[k] = isfinite(deviation) and n_usual >= LEAST_USUAL and n_off == 0
        if fault and n_back == 0 and isfinite(slope[k]):
            shift[k] = slope[k] * level
        if isfinite(ratio[k]) and (n_off == 0 or fault) and n_back != 1:
            value = ratio[k] - shift[k]
            ratio_mean = value if isnan(ratio_mean) else ratio_mean + (value - ratio_mean) / RATIO_MEMORY
    return shift, is_quiet


def _explains(effect: float, change: float) -> bool:
    """Whether a sensor error's effect explains a change, of the conductance or of the confirming difference."""
    return bool(isfinite(change) and effect != 0.0 and SHARE_LOW < change / effect < SHARE_HIGH)
