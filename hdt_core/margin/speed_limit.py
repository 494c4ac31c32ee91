"""The highest speed a compressor is let run at, learned from where its exit pressure falls short of what is asked."""

from dataclasses import dataclass

import numpy as np

from hdt_core.calibration.arrays import Array
from hdt_core.robust import spread

STRAYS = 10
"""Highest speeds that are passed over: spikes of the sensor, and its noise."""
BAND = 0.005
"""Share of the speed below which samples are at the limit: five times the sensor's noise."""
SHORT_SD, SHORT_SAMPLES, SHORT_SHARE = 4.0, 5, 0.25
"""At a limit this many samples, and this share of them, lack more exit pressure than so many standard deviations."""


@dataclass(frozen=True, slots=True)
class SpeedLimit:
    """What compressors are held below.

    Attributes
    ----------
    rad_s : float, optional
        The limit, or the highest speed on record where none was met; None without a record. [rad/s]
    met : bool
        Whether they were seen at it: the exit pressure falls short of its schedule there.
    """

    rad_s: float | None = None
    met: bool = False


def speed_limit(speed_rad_s: Array, beyond_schedule_ln: Array) -> SpeedLimit:
    """Limit from samples of a baseline: speed, and ln of exit pressure over its schedule, (n,) each; NaN is left out.

    A controller holds the pressure to half a per cent as long as it may turn the machine faster.
    """
    known = np.isfinite(speed_rad_s) & np.isfinite(beyond_schedule_ln) & (speed_rad_s > 0.0)
    speed, beyond = speed_rad_s[known], beyond_schedule_ln[known]
    if speed.size <= STRAYS:
        return SpeedLimit()
    highest = np.sort(speed)[-STRAYS - 1]
    near = speed > (1.0 - BAND) * highest
    short = beyond[near] - np.median(beyond) < -SHORT_SD * spread(beyond - np.median(beyond))
    met = short.sum() >= SHORT_SAMPLES and short.mean() >= SHORT_SHARE
    return SpeedLimit(float(np.median(speed[near]) if met else highest), bool(met))
