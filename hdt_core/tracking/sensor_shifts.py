"""A second witness for each sensor the conductance leans on: a sensor that steps or drifts is not a core that fouls.

Pack flow is also seen at the compressor's inlet, TAT at the compressors' inlets, the exchanger's exit temperature by
the other pack, whose controller keeps a constant distance while both doors can move, the door's position by climb and
descent. Where a witness departs from what it always said, and the conductance departs with it as that sensor's error
would make it, the error is taken out. Two witnesses need no such step, and so may judge a slow drift: climb and descent
have no other reason to leave the cruise, and both packs' compressors see TAT leave them alike.
"""

from math import copysign, isfinite, isnan, nan, sqrt
from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.records.keys import PACK


class RedundantSensor(NamedTuple):
    """Where a second sensor speaks.

    Columns of its departure, of the ln conductance ratio's derivative by it (empty: they move alike), and of what
    vouches for it (empty: none); least departure worth a second look, flights it remembers, and flights in a row that
    must depart one way before it is believed.
    """

    apart: str
    slope: str
    least: float
    vouch: str = ""
    memory: float = 40.0
    confirmed: int = 2


LONG = 200.0
"""Flights over which a vouched witness learns what is usual: what a drift adds in that time is seen. Sound ones keep
their level to a third of their flight-to-flight scatter over years."""
REDUNDANT_SENSORS = (
    # a door that reads wrong moves the ratio of cruise, and that of climb and descent by twice as much
    # it vouches for itself alone: a few samples of climb may err for a flight or two, and not for ten one way
    RedundantSensor("door_apart_ln", "", 0.04, "door_apart_ln", LONG, confirmed=10),
    RedundantSensor("exit_apart_k", "ratio_per_exit_k", 1.2),
    RedundantSensor("flows_apart_ln", "ratio_per_ln_flow", 0.03),
    RedundantSensor("tat_apart_k", "ratio_per_tat_k", 0.8, "other_tat_apart_k", LONG),
)
GATE_SD = 4.0
RATIO_MEMORY, SHIFT_MEMORY = 6.0, 8.0
CONFIRMED = 2
SHARE_LOW, SHARE_HIGH = 0.4, 2.0
SHIFT_SD = 0.15
"""Part of a correction that may be wrong."""


class Corrections(NamedTuple):
    """For each row: ln ratio to subtract, its variance, and whether a sensor is held at fault. (n,)"""

    shift: Array
    variance: Array
    fault: Array


def corrections(flights: pl.DataFrame) -> Corrections:
    """What sensor faults add to the ln conductance ratio of each row; rows in order, past rows only
    count."""
    n = flights.height
    total = Corrections(np.zeros(n), np.zeros(n), np.zeros(n, dtype=bool))
    if not n:
        return total
    seen = _beside(flights)
    pack = seen.select(pl.struct(PACK).rank("dense"))[:, 0].to_numpy().astype(np.int64)
    ratio = seen["ln_ua_ratio"].to_numpy().astype(float)
    for witness in REDUNDANT_SENSORS:
        if witness.apart not in seen.columns:
            continue
        apart = seen[witness.apart].to_numpy().astype(float)
        slope = seen[witness.slope].to_numpy().astype(float) if witness.slope else np.ones(n)
        vouch = seen[witness.vouch].to_numpy().astype(float) if witness.vouch else np.full(n, np.nan)
        for rows in np.split(np.arange(n), np.flatnonzero(np.diff(pack)) + 1):
            left = ratio[rows] - total.shift[rows]
            found = np.array(
                _walk(apart[rows].tolist(), slope[rows].tolist(), left.tolist(), vouch[rows].tolist(), witness)
            )
            total.shift[rows] += found
            total.variance[rows] += (SHIFT_SD * found) ** 2
            total.fault[rows] |= found != 0.0
    return total


def _beside(flights: pl.DataFrame) -> pl.DataFrame:
    """Flights with what the other pack says of TAT."""
    if "tat_apart_k" not in flights.columns:
        return flights
    key = [*PACK, "flight_id"]
    other = flights.select(
        *PACK[:2],
        (3 - pl.col("pack")).cast(flights.schema["pack"]).alias("pack"),
        "flight_id",
        other_tat_apart_k="tat_apart_k",
    )
    return flights.join(other.unique(key), on=key, how="left", maintain_order="left", validate="m:1")


def _walk(
    apart: list[float], slope: list[float], ratio: list[float], vouch: list[float], witness: RedundantSensor
) -> list[float]:
    """Follow one witness along a pack; the correction of each flight, from that flight and earlier ones.

    Plain numbers: one by one they take a third of the time of NumPy's.
    """
    shift = [0.0] * len(apart)
    usual, last, spread, met, beside, met_beside = 0.0, 0.0, witness.least / GATE_SD, 0, 0.0, 0
    held, departed, returned, sign, fault, level = nan, 0, 2, 0.0, False, 0.0
    second, heard = 0.0, 0
    for k in range(len(apart)):
        off = apart[k] - usual
        if isfinite(off):
            if met >= 5 and abs(off) > max(witness.least, GATE_SD * spread):
                departed = departed + 1 if copysign(1.0, off) == sign else 1
                sign, returned = copysign(1.0, off), 0
                level = off if departed == 1 else level + (off - level) / min(departed, SHIFT_MEMORY)
                if isfinite(vouch[k]):
                    heard = heard + 1 if departed > 1 else 1
                    second += (vouch[k] - beside - second) / min(heard, SHIFT_MEMORY)
                if not fault and departed >= witness.confirmed:
                    if min(met_beside, heard) >= CONFIRMED:
                        fault = _alike(second, level)
                    else:
                        fault = _to_blame(ratio[k] - held, slope[k] * level)
            else:
                returned += 1
                if returned >= CONFIRMED or not fault:
                    departed, fault = 0, False
                met += 1
                gain = 1.0 / min(met, witness.memory)
                # of steps from flight to flight: a drift must not pass for scatter
                spread += gain * (1.25 * abs(apart[k] - last) / sqrt(2.0) - spread) if met > 1 else 0.0
                usual, last = usual + gain * off, apart[k]
                if isfinite(vouch[k]):
                    met_beside += 1
                    beside += (vouch[k] - beside) / min(met_beside, witness.memory)
        if fault and returned == 0 and isfinite(slope[k]):
            shift[k] = slope[k] * level
        if isfinite(ratio[k]) and (departed == 0 or fault) and returned != 1:
            corrected = ratio[k] - shift[k]
            held = corrected if isnan(held) else held + (corrected - held) / RATIO_MEMORY
    return shift


def _alike(vouched: float, off: float) -> bool:
    """Whether a second look finds the same departure."""
    return bool(isfinite(vouched) and SHARE_LOW < vouched / off < SHARE_HIGH)


def _to_blame(change: float, expected: float) -> bool:
    """Whether the conductance moved as this sensor's error would move it."""
    return bool(isfinite(change) and expected != 0.0 and SHARE_LOW < change / expected < SHARE_HIGH)
