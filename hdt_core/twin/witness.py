"""A second witness for each sensor the conductance leans on: a sensor that steps or drifts is not a core that fouls.

Pack flow is also seen at the compressor's inlet, TAT at the compressors' inlets, the exchanger's exit temperature by
the other pack, whose controller keeps a constant distance while both doors can move. Where a witness departs from
what it always said, and the conductance departs with it as that sensor's error would make it, the error is taken out.
"""

from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.twin.crossing import PACK, Array

WITNESSES: dict[str, tuple[str, float]] = {
    # apart column: derivative column of the ln conductance ratio by it, least departure worth a second look
    "exit_apart_k": ("ratio_per_exit_k", 1.2),
    "flows_apart_ln": ("ratio_per_ln_flow", 0.03),
    "tat_apart_k": ("ratio_per_tat_k", 1.2),
}
GATE_SD = 4.0
MEMORY_FLIGHTS, RATIO_MEMORY, SHIFT_MEMORY = 40.0, 6.0, 8.0
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
    pack = flights.select(pl.struct(PACK).rank("dense"))[:, 0].to_numpy().astype(np.int64)
    ratio = flights["ln_ua_ratio"].to_numpy().astype(float)
    for apart, (slope, gate) in WITNESSES.items():
        if apart not in flights.columns:
            continue
        values, slopes = (flights[c].to_numpy().astype(float) for c in (apart, slope))
        for rows in np.split(np.arange(n), np.flatnonzero(np.diff(pack)) + 1):
            found = _walk(values[rows], slopes[rows], ratio[rows] - total.shift[rows], gate)
            total.shift[rows] += found
            total.variance[rows] += (SHIFT_SD * found) ** 2
            total.fault[rows] |= found != 0.0
    return total


def _walk(apart: Array, slope: Array, ratio: Array, least: float) -> Array:
    """Follow one witness along a pack; the correction of each flight, from that flight and earlier ones."""
    shift = np.zeros(len(apart))
    usual, spread, met = 0.0, least / GATE_SD, 0
    held, departed, returned, sign, fault, level = np.nan, 0, 2, 0.0, False, 0.0
    for k in range(len(apart)):
        off = apart[k] - usual
        if np.isfinite(off):
            if met >= 5 and abs(off) > max(least, GATE_SD * spread):
                departed = departed + 1 if np.sign(off) == sign else 1
                sign, returned = np.sign(off), 0
                level = off if departed == 1 else level + (off - level) / min(departed, SHIFT_MEMORY)
                if not fault and departed >= CONFIRMED:
                    fault = _to_blame(ratio[k] - held, slope[k] * level)
            else:
                returned += 1
                if returned >= CONFIRMED or not fault:
                    departed, fault = 0, False
                met += 1
                gain = 1.0 / min(met, MEMORY_FLIGHTS)
                spread += gain * (1.25 * abs(off) - spread) if met > 1 else 0.0
                usual += gain * off
        if fault and returned == 0 and np.isfinite(slope[k]):
            shift[k] = slope[k] * level
        if np.isfinite(ratio[k]) and (departed == 0 or fault) and returned != 1:
            corrected = ratio[k] - shift[k]
            held = corrected if np.isnan(held) else held + (corrected - held) / RATIO_MEMORY
    return shift


def _to_blame(change: float, expected: float) -> bool:
    """Whether the conductance moved as this sensor's error would move it."""
    return bool(np.isfinite(change) and expected != 0.0 and SHARE_LOW < change / expected < SHARE_HIGH)
