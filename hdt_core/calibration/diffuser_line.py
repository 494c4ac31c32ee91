"""Fit a line over the diffuser's position that machines share, each block of a pack's flights with its own level.

Levels are free for every twenty flights of a pack, so that units, sensors, wear and replacements fall into them and not
into the line.
"""

from dataclasses import dataclass

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.components.compressor import CC
from hdt_core.physics.model import declared
from hdt_core.records.keys import PACK
from hdt_core.robust import group_means, huber_weights, spread, spread_expr

BLOCK_FLIGHTS = 20
"""Flights within which a compressor hardly wears; also those from which a level as built is taken."""
VDA_NOISE_COUNTS = declared(CC.model.signal("vda_counts").sigma)
HUBER_STEPS = 8
FAR_SD = 4.0
"""Robust standard deviations beyond which a position is a spike of its sensor: one would bias a slope."""


@dataclass(frozen=True, slots=True)
class BlockRows:
    """Diameters against positions, the block (level) and the flight of each, and the pack and turn of each block."""

    x: Array
    y: Array
    block: Array
    flight: Array
    blocks: pl.DataFrame


def rows_of(samples: pl.DataFrame, column: str) -> BlockRows:
    """Build rows of a column of `compressor_samples` against the diffuser's position, by pack and time."""
    rows = samples.select(*PACK, "time_utc", "flight_id", "vda_counts", column)
    rows = rows.drop_nulls([column, "vda_counts"]).sort(*PACK, "time_utc", "flight_id")
    middle = pl.col("vda_counts").median().over(PACK)
    scatter = spread_expr(pl.col("vda_counts") - middle).over(PACK)
    rows = rows.filter((pl.col("vda_counts") - middle).abs() <= FAR_SD * scatter + VDA_NOISE_COUNTS)
    order = rows.select(pl.col("flight_id").rle_id().over(PACK).alias("order"), *PACK)
    turns = order.with_columns(turn=pl.col("order") // BLOCK_FLIGHTS)
    block = turns.select(pl.struct(*PACK, "turn").rle_id())[:, 0].to_numpy().astype(np.int64)
    flight = turns.select(pl.struct(*PACK, "order").rle_id())[:, 0].to_numpy().astype(np.int64)
    blocks = turns.select(*PACK, "turn").unique(maintain_order=True)
    x, y = (rows[c].to_numpy().astype(float) for c in ("vda_counts", column))
    return BlockRows(x, y, block, flight, blocks)


@dataclass(frozen=True, slots=True)
class Line:
    """A line over the diffuser's positions that machines share, the slope that of a machine of mean level.

    `level` is each block's at `centre`.
    """

    slope: float
    slope_sd: float
    level: Array
    centre: float
    residual: Array


def fit_line(rows: BlockRows) -> Line:
    """Fit the shared line, its slope corrected for the attenuation by noise in the positions."""
    slope, level, weight = _fit_slope(rows)
    deviation = rows.x - group_means(rows.x[:, None], rows.block, weight)[0][rows.block, 0]
    reliable = 1.0 - min(VDA_NOISE_COUNTS**2 / float(np.average(deviation**2, weights=weight)), 0.5)
    centre = float(np.average(rows.x, weights=weight))
    residual = rows.y - _line_values(rows, slope, level, centre)
    slope_sd = _clustered_sd(deviation, residual, rows.flight, weight) / reliable
    return Line(slope / reliable, slope_sd, level, centre, residual)


def _fit_slope(rows: BlockRows) -> tuple[float, Array, Array]:
    """Estimate the slope of a machine of mean level, the level of each block at the mean position, Huber's weights."""
    x, y, block = rows.x, rows.y, rows.block
    weight, scale = np.ones(len(x)), np.ones(len(rows.blocks))
    slope, level = 0.0, scale
    for _ in range(HUBER_STEPS):
        x_mean, y_mean = group_means(np.column_stack([x, y]), block, weight)[0].T
        dx, dy = x - x_mean[block], (y - y_mean[block]) / scale[block]
        slope = float((weight * dx * dy).sum() / max((weight * dx * dx).sum(), 1e-9))
        level = y_mean + slope * scale * (np.average(x, weights=weight) - x_mean)
        # wear scales the whole diameter, the slope too
        scale = level / level.mean()
        deviation = np.abs(dy - slope * dx)
        weight = huber_weights(deviation, spread(deviation))
    return slope, level, weight


def _line_values(rows: BlockRows, slope: float, level: Array, centre: float) -> Array:
    return np.asarray(level[rows.block] * (1.0 + slope / level.mean() * (rows.x - centre)))


def _clustered_sd(deviation: Array, residual: Array, flight: Array, weight: Array) -> float:
    """Compute the slope's standard error with errors clustered by flight: sandwich of Huber's estimate, to which a
    sample beyond the bend adds nothing."""
    score = np.bincount(flight, weight * deviation * residual)
    return float(np.sqrt((score**2).sum()) / max((deviation[weight >= 1.0] ** 2).sum(), 1e-9))
