"""Schedules of the aircraft's controllers, learned from their records: relations of readings whatever the wear.

The pack temperature controller opens the ram door until the exchanger's hot outlet is at a target scheduled on total
air temperature, plus a constant trim of the flight: while the door has authority the outlet carries no information on
wear, only on controller, door and outlet sensor. The cabin pressure controller schedules cabin pressure on altitude;
the compressor delivers that plus the pressure loss of its flow in pack and ducts.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import polars as pl

from hdt_core.flight.quality import RUNNING_KG_S
from hdt_core.loading import with_tuples
from hdt_core.physics.model import Array
from hdt_core.records.keys import AIRCRAFT, FLIGHT, LEG, PACK
from hdt_core.robust import huber_slopes, spread

FULL_OPEN = 0.95
"""Opening above which the ram door is full open: two per cent of sensor error, and a flat end of travel. [-]"""
DOOR_FREE = (0.08, FULL_OPEN)
"""Between these openings the door has authority: outside, the outlet may leave its target."""
ROUGHNESS = 10.0
"""Penalty on a kink between knots, in samples: a schedule is straight where samples are few."""
MIN_SAMPLES = 300
"""Samples required for an aircraft's own schedule; with fewer it takes that of all aircraft."""
TAT_KNOTS_K = tuple(np.arange(228.0, 317.0, 8.0).tolist())


def has_authority(prefix: str = "") -> pl.Expr:
    """Whether the pack runs and its door (or, with a prefix, the other pack's) is away from both its ends."""
    return pl.col(f"{prefix}ram_door_open").is_between(*DOOR_FREE) & (pl.col(f"{prefix}pack_flow_kg_s") > RUNNING_KG_S)


@dataclass(frozen=True, slots=True)
class ControlSchedule:
    """Piecewise-linear schedule of a reading on another, plus a gain on a third, up to a constant of each pack.

    Attributes
    ----------
    knots : tuple of float
        Abscissae of the schedule.
    shapes : mapping
        Tail to the schedule's value at the knots, mean zero; the key `""` holds that of all tails together.
    gains : mapping
        Tail to the factor on the third reading; 0 where there is none.
    levels : mapping
        `tail/pack` to the constant that its readings had in the window, `""` to that of all.
    """

    knots: tuple[float, ...]
    shapes: Mapping[str, tuple[float, ...]]
    gains: Mapping[str, float]
    levels: Mapping[str, float] = field(default_factory=dict)

    def level_column(self, packs: pl.DataFrame) -> pl.Series:
        """Return the constant of each row's pack (`tail`, `pack`); that of all packs for an unknown one."""
        name = pl.concat_str("tail", "pack", separator="/")
        levels = name.replace_strict(dict(self.levels), default=self.levels.get(""), return_dtype=pl.Float64)
        return packs.select(levels)[:, 0]

    def shape(self, tail: str, x: Array, third: Array | float = 0.0) -> Array:
        """Return the scheduled part of the reading."""
        key = tail if tail in self.shapes else ""
        heights = self.shapes.get(key, (0.0,) * len(self.knots))
        return np.asarray(np.interp(x, self.knots, heights) + self.gains.get(key, 0.0) * third)

    def column(self, tail: Array, x: Array, third: Array | float = 0.0) -> pl.Series:
        """Return the scheduled part for rows of many tails; null where an argument is missing."""
        third = np.broadcast_to(np.asarray(third, dtype=float), x.shape)
        out = np.full(len(x), np.nan)
        for name in np.unique(tail.astype(str)):
            rows = tail == name
            out[rows] = self.shape(name, x[rows], third[rows])
        return pl.Series(out).fill_nan(None)


def learn_outlet_schedule(samples: pl.DataFrame) -> ControlSchedule:
    """Learn the target of the hot outlet [K] on total temperature [K], up to a constant of each flight and pack."""
    flight = pl.struct("tail", "flight_id", "pack").rank("dense").cast(pl.Int64).alias("group")
    rows = samples.filter(has_authority())
    return fit_schedule(rows.select("tail", "pack", flight, x="tat_k", y="hx_out_k", third=pl.lit(0.0)), TAT_KNOTS_K)


def fit_schedule(rows: pl.DataFrame, knots: tuple[float, ...]) -> ControlSchedule:
    """Fit `y` on `x` and `third` with a constant for each `group`, for all tails and for each with enough rows.

    Regression on hat functions with a constant for each group (taken out by centring), a penalty on second differences,
    and three rounds of Huber weights, so a jammed door or a drifting sensor in the window has little weight.
    """
    complete = rows.drop_nulls()
    fits = {"": _fit_knots(complete, knots)}
    for (tail,), own in complete.group_by("tail", maintain_order=True):
        if own.height >= MIN_SAMPLES:
            fits[str(tail)] = _fit_knots(own, knots)
    law = ControlSchedule(knots, {k: v[0] for k, v in fits.items()}, {k: v[1] for k, v in fits.items()})
    return replace(law, levels=_levels(law, complete))


def _levels(law: ControlSchedule, rows: pl.DataFrame) -> dict[str, float]:
    """Return the median residual of each pack from the schedule, and of all packs under `""`."""
    residuals = rows.select("tail", "pack", residual=above_schedule(law, rows))
    own = residuals.group_by("tail", "pack").agg(pl.col("residual").median()).sort("tail", "pack")
    levels = {f"{tail}/{pack}": float(level) for tail, pack, level in own.rows()}
    return levels | ({"": float(residuals["residual"].median())} if rows.height else {})  # type: ignore[arg-type]


def above_schedule(law: ControlSchedule, rows: pl.DataFrame) -> pl.Series:
    """Return `y` less its scheduled part."""
    return rows["y"] - law.column(*(rows[c].to_numpy() for c in ("tail", "x", "third")))


def _fit_knots(rows: pl.DataFrame, knots: tuple[float, ...]) -> tuple[tuple[float, ...], float]:
    """Fit the schedule at the knots, mean zero, and the gain of the third reading; flat for too few rows."""
    n = len(knots)
    if rows.height < 2 * n:
        return (0.0,) * n, 0.0
    group = rows["group"].rank("dense").to_numpy().astype(np.int64)
    hats = np.stack([np.interp(rows["x"].to_numpy(), knots, row) for row in np.eye(n)], axis=1)
    basis = np.column_stack([hats, rows["third"].to_numpy()])
    y = rows["y"].to_numpy()
    bend = np.diff(np.eye(n, n + 1), 2, axis=0)
    # the groups' constants absorb any other, so a weak ridge makes the solution unique
    ridge = ROUGHNESS * bend.T @ bend + 1e-6 * np.eye(n + 1)
    coefficients = huber_slopes(basis, y, ridge, 4, 1.5, group)
    heights = coefficients[:n] - coefficients[:n].mean()
    return tuple(float(v) for v in heights), float(coefficients[n])


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
    speed = speed_rad_s[valid]
    beyond = beyond_schedule_ln[valid]
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
"""Columns of the samples that the schedules are learned from."""


def learn_schedules(samples: pl.DataFrame) -> ControlSchedules:
    """Learn the schedules of each aircraft's controllers from its baseline window; later samples are ignored.

    Parameters
    ----------
    samples : DataFrame
        `legs_samples` or snapshots with a phase: signals in SI.
    """
    window = _baseline(samples.select(SAMPLE_COLUMNS))
    pack = pl.struct(PACK).rank("dense").cast(pl.Int64).alias("group")
    flow2 = pl.col("pack_flow_kg_s") ** 2
    running = (pl.col("phase") == "cruise") & (pl.col("pack_flow_kg_s") > RUNNING_KG_S) & (pl.col("cc_out_pa") > 0)
    running_rows = window.filter(running)
    delivery_rows = running_rows.select("tail", "pack", pack, x="altitude_m", y=pl.col("cc_out_pa").log(), third=flow2)
    delivery = fit_schedule(delivery_rows, ALTITUDE_KNOTS_M)
    beyond = above_schedule(delivery, delivery_rows) - delivery.level_column(delivery_rows)
    limit = speed_limit(running_rows["cc_speed_rad_s"].cast(pl.Float64).to_numpy(), beyond.to_numpy())
    return ControlSchedules(learn_outlet_schedule(window), delivery, limit)


def _baseline(samples: pl.DataFrame) -> pl.DataFrame:
    start = samples.group_by(FLIGHT).agg(pl.col("time_utc").min().alias("start"))
    order = pl.struct("start", "flight_id").rank("ordinal").over(AIRCRAFT)
    return samples.join(start.filter(order <= LEARNING_FLIGHTS), on=FLIGHT, how="semi")
