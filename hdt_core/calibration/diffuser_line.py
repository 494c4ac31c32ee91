"""Fit a line over the diffuser's position that machines share, each block of a pack's flights with its own level.

Levels are free for every twenty flights of a pack, so that units, sensors, wear and replacements fall into them and not
into the line.
"""

from dataclasses import dataclass

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.components.compressor import CC
from hdt_core.estimation.panel import Equation, Panel, PanelLeastSquares, Walk
from hdt_core.estimation.problem import unknown
from hdt_core.physics.model import declared
from hdt_core.records.keys import PACK
from hdt_core.robust import group_means, huber_weights, spread, spread_expr

BLOCK_FLIGHTS = 20
"""Flights within which a compressor hardly wears; also those from which a level as built is taken."""
VDA_NOISE_COUNTS = declared(CC.model.signal("vda_counts").sigma)
SCATTER, LEVEL_SD = 0.03, 1e3
"""Scatter of a sample about the line as a share of it, the paper's 5.5 mm; nothing is assumed of a level."""
COUNTS, STEP, STILL = 1e3, 1e-4, Walk(step_sd=1.0, time_sd=0.0, first_sd=1e-6)
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
    centre, size = float(rows.x.mean()), float(np.median(rows.y))
    estimate, of_block = PanelLeastSquares().estimate(line_panel(rows, centre, size))
    level, steepness = size * of_block[:, 0], float(estimate.belief.mean[0]) / COUNTS
    residual = rows.y - level[rows.block] * (1.0 + steepness * (rows.x - centre))
    weight = huber_weights(np.abs(residual), spread(residual))
    deviation = rows.x - group_means(rows.x[:, None], rows.block, np.ones(len(weight)))[0][rows.block, 0]
    reliable = 1.0 - VDA_NOISE_COUNTS**2 / max(float((deviation**2).mean()), 2.0 * VDA_NOISE_COUNTS**2)
    slope, slope_sd = steepness * float(level.mean()), _clustered_sd(deviation, residual, rows.flight, weight)
    return Line(slope / reliable, slope_sd / reliable, level, centre, residual)


def line_panel(rows: BlockRows, centre: float, size: float) -> Panel:
    """Declare the panel of blocks, their levels over `size`, that share a steepness: wear scales the slope too."""
    x, y, ones = (rows.x - centre) / COUNTS, rows.y / size, np.ones((len(rows.blocks), 1))
    return Panel(
        names=("steepness",), bounds=np.array([[-np.inf, np.inf]]), prior=unknown(np.zeros(1)), step=np.full(1, STEP),
        unit_mean=ones, unit_sd=LEVEL_SD * ones, unit_step=np.full(1, STEP), unit=rows.block, time=rows.block,
        levelled=Equation(lambda design, level: y - level[0] * (1.0 + design[0] * x), SCATTER),
        walk=STILL, noise_sd=np.zeros((len(x), 1)),
    )  # fmt: skip


def _clustered_sd(deviation: Array, residual: Array, flight: Array, weight: Array) -> float:
    """Compute the slope's standard error with errors clustered by flight: sandwich of Huber's estimate, to which a
    sample beyond the bend adds nothing."""
    score = np.bincount(flight, weight * deviation * residual)
    return float(np.sqrt((score**2).sum()) / max((deviation[weight >= 1.0] ** 2).sum(), 1e-9))
