"""A controller's schedule of one reading on another, learned from records, whatever the wear.

The pack temperature controller opens the ram door until the exchanger's hot outlet is at a target scheduled on total
air temperature, plus a constant trim of the flight: while the door has authority the outlet carries no information on
wear, only on controller, door and outlet sensor.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import polars as pl

from hdt_core.flight.legs import RUNNING_KG_S
from hdt_core.physics.model import Array
from hdt_core.robust import huber_slopes

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
    basis, y = np.column_stack([hats, rows["third"].to_numpy()]), rows["y"].to_numpy()
    bend = np.diff(np.eye(n, n + 1), 2, axis=0)
    # the groups' constants absorb any other, so a weak ridge makes the solution unique
    ridge = ROUGHNESS * bend.T @ bend + 1e-6 * np.eye(n + 1)
    coefficients = huber_slopes(basis, y, ridge, 4, 1.5, group)
    heights = coefficients[:n] - coefficients[:n].mean()
    return tuple(float(v) for v in heights), float(coefficients[n])
