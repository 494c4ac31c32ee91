"""Schedules of the aircraft's controllers, learned from their records: relations of readings whatever the wear.

The hot outlet's is that of `flight.control_schedule`. The cabin pressure controller schedules cabin pressure on
altitude; the compressor delivers that plus the pressure loss of its flow in pack and ducts.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.flight.control_schedule import ControlSchedule, above_schedule, fit_schedule, learn_outlet_schedule
from hdt_core.flight.legs import RUNNING_KG_S
from hdt_core.loading import with_tuples
from hdt_core.records.keys import AIRCRAFT, FLIGHT, LEG, PACK
from hdt_core.robust import spread

LEARNING_FLIGHTS = 60
"""First flights of each aircraft, from which the schedules are learned (the declared baseline window)."""
ALTITUDE_KNOTS_M = tuple(np.arange(4800.0, 14401.0, 800.0).tolist())
STRAY_SAMPLES = 10
"""Highest speeds left out as spikes or noise of the sensor."""
BAND = 0.005
"""Share of the speed below which samples are at the limit: five times the sensor's noise."""
SHORT_SD, SHORT_SAMPLES, SHORT_SHARE = 4.0, 5, 0.25
"""Shortfall of exit pressure at a speed limit, in standard deviations, and number and share of samples with it."""


@dataclass(frozen=True, slots=True)
class SpeedLimit:
    """Speed limit of the compressors.

    Attributes
    ----------
    rad_s : float, optional
        The limit, or the highest speed on record where it was not reached; None without a record. [rad/s]
    at_limit : bool
        Whether it was reached: the exit pressure falls short of its schedule there.
    """

    rad_s: float | None = None
    at_limit: bool = False


def speed_limit(speed_rad_s: Array, beyond_schedule_ln: Array) -> SpeedLimit:
    """Learn the limit from samples of a baseline: speed, and ln of exit pressure over schedule, (n,); NaN is ignored.

    A controller holds the pressure to half a per cent as long as it may turn the machine faster.
    """
    valid = np.isfinite(speed_rad_s) & np.isfinite(beyond_schedule_ln) & (speed_rad_s > 0.0)
    speed, beyond = speed_rad_s[valid], beyond_schedule_ln[valid]
    if speed.size <= STRAY_SAMPLES:
        return SpeedLimit()
    highest = np.sort(speed)[-STRAY_SAMPLES - 1]
    near = speed > (1.0 - BAND) * highest
    short = beyond[near] - np.median(beyond) < -SHORT_SD * spread(beyond - np.median(beyond))
    at_limit = short.sum() >= SHORT_SAMPLES and short.mean() >= SHORT_SHARE
    return SpeedLimit(float(np.median(speed[near]) if at_limit else highest), bool(at_limit))


@dataclass(frozen=True, slots=True)
class ControlSchedules:
    """Schedules of the controllers of a fleet.

    Attributes
    ----------
    outlet : ControlSchedule
        Hot outlet temperature [K] on total temperature [K]; a flight and pack has its own constant.
    delivery : ControlSchedule
        ln of compressor exit pressure on altitude [m] and pack flow squared [kg2/s2]; a pack has its own constant.
    speed : SpeedLimit
        Speed limit of the compressors.
    """

    outlet: ControlSchedule
    delivery: ControlSchedule
    speed: SpeedLimit = field(default_factory=SpeedLimit)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self) | {"speed": {"rad_s": self.speed.rad_s, "met": self.speed.at_limit}}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> "ControlSchedules":
        """Read schedules from the values of `to_dict`."""
        outlet, delivery = (ControlSchedule(**with_tuples(plain[name])) for name in ("outlet", "delivery"))
        return cls(outlet, delivery, SpeedLimit(plain["speed"]["rad_s"], plain["speed"]["met"]))


SAMPLE_COLUMNS = (
    *LEG, "time_utc", "phase", "altitude_m", "tat_k", "hx_out_k", "ram_door_open", "pack_flow_kg_s", "cc_out_pa",
    "cc_speed_rad_s",
)  # fmt: skip
"""Columns of the samples that the schedules are learned from; a flight may lack the last."""


def learn_schedules(samples: pl.DataFrame) -> ControlSchedules:
    """Learn the schedules of each aircraft's controllers from its baseline window; later samples are ignored.

    Parameters
    ----------
    samples : DataFrame
        `legs_samples` or snapshots with a phase: signals in SI.
    """
    window = _baseline(samples.select(pl.selectors.by_name(*SAMPLE_COLUMNS, require_all=False)))
    pack = pl.struct(PACK).rank("dense").cast(pl.Int64).alias("group")
    flow2 = pl.col("pack_flow_kg_s") ** 2
    running = (pl.col("phase") == "cruise") & (pl.col("pack_flow_kg_s") > RUNNING_KG_S) & (pl.col("cc_out_pa") > 0)
    running_rows = window.filter(running)
    delivery_rows = running_rows.select("tail", "pack", pack, x="altitude_m", y=pl.col("cc_out_pa").log(), third=flow2)
    delivery = fit_schedule(delivery_rows, ALTITUDE_KNOTS_M)
    beyond = above_schedule(delivery, delivery_rows) - delivery.level_column(delivery_rows)
    no_speed = pl.repeat(None, running_rows.height, dtype=pl.Float64, eager=True)
    speed = running_rows.get_column("cc_speed_rad_s", default=no_speed).cast(pl.Float64)
    limit = speed_limit(speed.to_numpy(), beyond.to_numpy())
    return ControlSchedules(learn_outlet_schedule(window), delivery, limit)


def _baseline(samples: pl.DataFrame) -> pl.DataFrame:
    start = samples.group_by(FLIGHT).agg(pl.col("time_utc").min().alias("start"))
    order = pl.struct("start", "flight_id").rank("ordinal").over(AIRCRAFT)
    return samples.join(start.filter(order <= LEARNING_FLIGHTS), on=FLIGHT, how="semi")
