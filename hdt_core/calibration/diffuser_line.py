"""Fit a line over the diffuser's position that machines share, and rank it among the forms of equation (6).

Levels are free for every twenty flights of a pack, so that units, sensors, wear and replacements fall into them and not
into the line.
"""

from dataclasses import dataclass

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.components.pack import CC
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
"""Robust standard deviations beyond which a position is a spike of its sensor, which would bias a slope; other samples
too where a method squares residuals."""
FOLDS, RESAMPLES = 5, 200
FORMS = {"constant": 0, "linear": 1, "quadratic": 2, "cubic": 3}
MOST_SAMPLES = 60_000


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
    rows = regular_samples(samples.select(*PACK, "time_utc", "flight_id", "vda_counts", column), column)
    order = rows.select(pl.col("flight_id").rle_id().over(PACK).alias("order"), *PACK)
    turns = order.with_columns(turn=pl.col("order") // BLOCK_FLIGHTS)
    block = turns.select(pl.struct(*PACK, "turn").rle_id())[:, 0].to_numpy().astype(np.int64)
    flight = turns.select(pl.struct(*PACK, "order").rle_id())[:, 0].to_numpy().astype(np.int64)
    blocks = turns.select(*PACK, "turn").unique(maintain_order=True)
    x, y = (rows[c].to_numpy().astype(float) for c in ("vda_counts", column))
    return BlockRows(x, y, block, flight, blocks)


def regular_samples(samples: pl.DataFrame, column: str) -> pl.DataFrame:
    """Select samples with this column and a position that is no spike, by pack and time."""
    rows = samples.drop_nulls([column, "vda_counts"]).sort(*PACK, "time_utc", "flight_id")
    middle = pl.col("vda_counts").median().over(PACK)
    scatter = spread_expr(pl.col("vda_counts") - middle).over(PACK)
    return rows.filter((pl.col("vda_counts") - middle).abs() <= FAR_SD * scatter + VDA_NOISE_COUNTS)


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
    centre = float(rows.x.mean())
    size = float(np.median(rows.y))
    estimate, of_block = PanelLeastSquares().estimate(line_panel(rows, centre, size))
    level = size * of_block[:, 0]
    steepness = float(estimate.belief.mean[0]) / COUNTS
    residual = rows.y - level[rows.block] * (1.0 + steepness * (rows.x - centre))
    weight = huber_weights(np.abs(residual), spread(residual))
    deviation = rows.x - group_means(rows.x[:, None], rows.block, np.ones(len(weight)))[0][rows.block, 0]
    reliable = reliable_share(deviation)
    slope = steepness * float(level.mean())
    slope_sd = _clustered_sd(deviation, residual, rows.flight, weight)
    return Line(slope / reliable, slope_sd / reliable, level, centre, residual)


def reliable_share(deviation: Array) -> float:
    """Compute the share of the positions' variance that is no noise, from their deviations within blocks."""
    return 1.0 - VDA_NOISE_COUNTS**2 / max(float((deviation**2).mean()), 2.0 * VDA_NOISE_COUNTS**2)


def line_panel(rows: BlockRows, centre: float, size: float) -> Panel:
    """Declare the panel of blocks, their levels over `size`, that share a steepness: wear scales the slope too."""
    x = (rows.x - centre) / COUNTS
    y = rows.y / size
    ones = np.ones((len(rows.blocks), 1))
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


@dataclass(frozen=True, slots=True)
class FormFit:
    """One form of equation (6): a polynomial of the diffuser's position of this degree, levels apart.

    Attributes
    ----------
    cv_mae_m, cv_rmse_m : float
        Error of held-out flights, five folds.
    aic : float
        Akaike's criterion, above that of the best form.
    r_squared, r_squared_low, r_squared_high : float
        Explained share of the variance about the levels, with a 95 % interval (flights resampled).
    """

    form: str
    cv_mae_m: float
    cv_rmse_m: float
    aic: float
    r_squared: float
    r_squared_low: float
    r_squared_high: float


def compare_forms(rows: BlockRows) -> tuple[FormFit, ...]:
    """Compare constant, linear, quadratic and cubic forms by error on held-out flights and by AIC.

    Errors are those of one sample against the curve at its pack's level, estimated from the other flights. Empty where
    there are fewer flights than folds.
    """
    rows = _thin(rows)
    n_flights = int(rows.flight.max()) + 1
    if n_flights < FOLDS:
        return ()
    z = (rows.x - rows.x.mean()) / max(float(rows.x.std()), 1e-9)
    fold = (np.cumsum(np.r_[0, np.diff(rows.flight) != 0])) % FOLDS
    rng = np.random.default_rng(0)
    picks = rng.multinomial(n_flights, np.full(n_flights, 1.0 / n_flights), RESAMPLES).astype(float)
    picks = picks[picks.any(axis=1)]  # of two flights a resample may hold none
    scores = []
    aics = []
    for form, degree in FORMS.items():
        basis = np.stack([z**k for k in range(1, degree + 1)], axis=1) if degree else np.zeros((len(z), 0))
        prediction = np.full(len(z), np.nan)
        for k in range(FOLDS):
            prediction[fold == k] = _predict(rows, basis, fold != k)[fold == k]
        error = rows.y - prediction
        error = error[np.isfinite(error)]
        about, rest = (rows.y - _predict(rows, b, np.ones(len(z), dtype=bool)) for b in (basis[:, :0], basis))
        parts = (picks @ np.bincount(rows.flight, v**2) for v in (rest, about))
        low, high = np.quantile(1.0 - np.divide(*parts), [0.025, 0.975])
        share = 1.0 - float((rest**2).sum() / (about**2).sum())
        aics.append(len(z) * float(np.log((rest**2).mean())) + 2.0 * (degree + len(rows.blocks)))
        scores.append((form, float(np.abs(error).mean()), float(np.sqrt((error**2).mean())), share, low, high))
    return tuple(
        FormFit(form, mae, rmse, aic - min(aics), share, float(low), float(high))
        for (form, mae, rmse, share, low, high), aic in zip(scores, aics, strict=True)
    )


def _thin(rows: BlockRows) -> BlockRows:
    """Select whole flights evenly, up to a number of samples that suffices to rank forms."""
    step = max(1, len(rows.x) // MOST_SAMPLES)
    mask = rows.flight % step == 0
    flight = np.unique(rows.flight[mask], return_inverse=True)[1]
    numbers, block = np.unique(rows.block[mask], return_inverse=True)
    return BlockRows(rows.x[mask], rows.y[mask], block, flight, rows.blocks[numbers.tolist()])


def _predict(rows: BlockRows, basis: Array, use: Array) -> Array:
    """Predict by least squares on `use`, with a level for each block; NaN where a block has none."""
    columns = np.column_stack([rows.y, basis])
    means, n = group_means(columns, rows.block, use.astype(float))
    means[n < 1.0] = np.nan
    deviations = columns - means[rows.block]
    slopes = np.linalg.lstsq(deviations[use, 1:], deviations[use, 0], rcond=None)[0]
    return np.asarray(means[rows.block, 0] + deviations[:, 1:] @ slopes)
