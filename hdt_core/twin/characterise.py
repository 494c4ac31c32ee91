"""What thousands of nominal flights say of the compressor as built: equation (6) and its rivals, the group of
equations (2)-(4), the efficiency.

A diameter is a flight's own level times a curve of the diffuser's position that the fleet shares. Levels are free for
every twenty flights of a pack, so that units, sensors, wear and replacements fall into them and not into the curve.
"""

from dataclasses import dataclass

import numpy as np
import polars as pl

from hdt_core.components.compressor import CC
from hdt_core.physics.model import declared
from hdt_core.records.keys import FLIGHT_PACK, PACK
from hdt_core.robust import huber_weights, median_error, spread, spread_expr
from hdt_core.twin.crossing import Array
from hdt_core.twin.forms import FormFit, Rows, compare_forms
from hdt_core.twin.pooling import Level, levels_of
from hdt_core.twin.sensors import CC_FLOW_BIAS_SD

PRIOR = {p.name: (p.nominal, declared(p.sd)) for p in CC.model.free("design")}
"""The paper's law with a wide band, as the component declares it."""
BLADE_ANGLE_RAD, BLADE_ANGLE_SD_RAD, HUB_RATIO = float(np.deg2rad(36.0)), float(np.deg2rad(3.0)), 0.4
"""Angle from tangential and hub to eye diameter of inducers of this kind: assumed, seen in no record."""
MIN_POINTS = 30
BLOCK_FLIGHTS = 20
"""Flights within which a compressor hardly wears; also those from which a level as built is taken."""
VDA_NOISE_COUNTS = declared(CC.model.signal("vda_counts").sigma)
HUBER_STEPS = 8
FAR_SD = 4.0
"""Robust standard deviations beyond which a position is a spike of its sensor: one would turn a slope."""
ENTRY_WEAR, ENTRY_WEAR_SD, ENTRY_UNIT_SD = 0.004, 0.008, 0.012
"""Mean ln loss of diameter of a compressor when first seen, how well that is known, and the spread of units: by so much
an as-built level lies above the seen one. No record tells; efficiency loses twice as much."""
PROBE_SD_LN = 0.003
"""Calibration error of an efficiency, which no number of flights takes out of one pack."""


@dataclass(frozen=True, slots=True)
class CompressorFit:
    """Equation (6), the group of equations (2)-(4) and the efficiency as built, each with its standard deviation."""

    intercept_m: float
    intercept_sd_m: float
    slope_m_per_count: float
    slope_sd_m_per_count: float
    scatter_m: float
    mae_m: float
    r_squared: float
    group_m3: float
    group_sd_m3: float
    efficiency: float
    efficiency_sd: float
    vda_counts: float
    n_flights: int
    forms: tuple[FormFit, ...] = ()
    levels: tuple[Level, ...] = ()


def fit_compressor(samples: pl.DataFrame) -> CompressorFit:
    """Characterise the compressor over the baseline.

    Parameters
    ----------
    samples : DataFrame
        Of `compressor_samples`, baseline flights only.

    Returns
    -------
    CompressorFit
        The paper's law with a wide band where the records hold too little.

    Notes
    -----
    The diffuser's reading is noisy, which flattens a slope by the share of noise in its variance; the slope is raised
    by as much. Levels are those of machines as first seen, raised by the wear that these bring along.
    """
    rows = _rows(samples)
    group, group_sd, group_levels = _pooled(
        samples, "group_m3", "cc_area_diameter_tan_beta_m3", CC_FLOW_BIAS_SD, wear=False
    )
    efficiency, efficiency_sd, efficiency_levels = _pooled(
        samples, "efficiency", "cc_efficiency", PROBE_SD_LN, wear=True
    )
    flights = samples.select(FLIGHT_PACK).unique().height
    if len(rows.x) < MIN_POINTS or flights == samples.select(PACK).unique().height:
        return _prior(flights)  # one flight a pack: nothing to compare within a machine
    slope, level, weight = _shared_slope(rows)
    x_mean = np.bincount(rows.block, weight * rows.x) / np.bincount(rows.block, weight)
    inside = rows.x - x_mean[rows.block]
    reliable = 1.0 - min(VDA_NOISE_COUNTS**2 / float(np.average(inside**2, weights=weight)), 0.5)
    centre = float(np.average(rows.x, weights=weight))
    residual = rows.y - _fitted(rows, slope, level, centre)
    seen = pl.DataFrame({"seen": level}).hstack(rows.blocks).filter(pl.col("turn") == 0)
    as_built, as_built_sd = _as_built(seen["seen"].to_numpy(), ENTRY_WEAR, ENTRY_WEAR_SD)
    # the slope belongs to machines as they were; an as-built one is that much larger
    slope = slope / reliable * as_built / float(np.mean(level))
    slope_sd = float(
        np.hypot(_clustered_sd(inside, residual, rows.flight, weight) / reliable, slope * as_built_sd / as_built)
    )
    form_fits = compare_forms(rows)
    line = form_fits[1] if form_fits else None
    return CompressorFit(
        intercept_m=as_built - slope * centre,
        intercept_sd_m=float(np.hypot(as_built_sd, slope_sd * centre)),
        slope_m_per_count=slope,
        slope_sd_m_per_count=slope_sd,
        scatter_m=spread(residual),
        mae_m=line.cv_mae_m if line else float(np.abs(residual).mean()),
        r_squared=line.r_squared if line else 0.0,
        group_m3=group,
        group_sd_m3=group_sd,
        efficiency=efficiency,
        efficiency_sd=efficiency_sd,
        vda_counts=centre,
        n_flights=flights,
        forms=form_fits,
        levels=(*group_levels, *efficiency_levels),
    )


def _prior(flights: int) -> CompressorFit:
    """The paper's equation (6) with a wide band, where the fleet's own records hold too little."""
    return CompressorFit(
        *PRIOR["cc_diameter_vda_intercept"], *PRIOR["cc_diameter_vda_slope"], 0.0055, 0.0055, 0.0,
        *PRIOR["cc_area_diameter_tan_beta_m3"], *PRIOR["cc_efficiency"], 400.0, flights,
    )  # fmt: skip


def _rows(samples: pl.DataFrame) -> Rows:
    known = samples.drop_nulls(["diameter_m", "vda_counts"]).sort(*PACK, "time_utc", "flight_id")
    middle = pl.col("vda_counts").median().over(PACK)
    scatter = spread_expr(pl.col("vda_counts") - middle).over(PACK)
    known = known.filter((pl.col("vda_counts") - middle).abs() <= FAR_SD * scatter + VDA_NOISE_COUNTS)
    order = known.select(pl.col("flight_id").rle_id().over(PACK).alias("order"), *PACK)
    turned = order.with_columns(turn=pl.col("order") // BLOCK_FLIGHTS)
    block = turned.select(pl.struct(*PACK, "turn").rle_id())[:, 0].to_numpy().astype(np.int64)
    flight = turned.select(pl.struct(*PACK, "order").rle_id())[:, 0].to_numpy().astype(np.int64)
    blocks = turned.select(*PACK, "turn").unique(maintain_order=True)
    x, y = (known[c].to_numpy().astype(float) for c in ("vda_counts", "diameter_m"))
    return Rows(x, y, block, flight, blocks)


def _shared_slope(rows: Rows) -> tuple[float, Array, Array]:
    """Slope of a machine of mean level, level of each block at the mean position, Huber's weights."""
    x, y, block = rows.x, rows.y, rows.block
    weight, scale = np.ones(len(x)), np.ones(len(rows.blocks))
    slope, level = 0.0, scale
    for _ in range(HUBER_STEPS):
        total = np.bincount(block, weight)
        x_mean, y_mean = (np.bincount(block, weight * v) / total for v in (x, y))
        dx, dy = x - x_mean[block], (y - y_mean[block]) / scale[block]
        slope = float((weight * dx * dy).sum() / max((weight * dx * dx).sum(), 1e-9))
        level = y_mean + slope * scale * (np.average(x, weights=weight) - x_mean)
        # wear takes its share of the whole diameter, of the slope too
        scale = level / level.mean()
        off = np.abs(dy - slope * dx)
        weight = huber_weights(off, spread(off))
    return slope, level, weight


def _fitted(rows: Rows, slope: float, level: Array, centre: float) -> Array:
    return np.asarray(level[rows.block] * (1.0 + slope / level.mean() * (rows.x - centre)))


def _clustered_sd(inside: Array, residual: Array, flight: Array, weight: Array) -> float:
    """Standard error of the slope where samples of a flight err together: sandwich over flights, of Huber's
    estimate, to whose slope a sample beyond the bend adds nothing."""
    score = np.bincount(flight, weight * inside * residual)
    return float(np.sqrt((score**2).sum()) / max((inside[weight >= 1.0] ** 2).sum(), 1e-9))


def _as_built(seen: Array, wear: float, wear_sd: float) -> tuple[float, float]:
    """Level as built of machines seen a little worn, and its standard error."""
    middle = float(np.median(seen))
    scatter = max(ENTRY_UNIT_SD * middle, spread(seen - middle))
    # the median over machines whose wear is exponential: ln 2 times its mean
    raised = middle * (1.0 + float(np.log(2.0)) * wear)
    return raised, float(np.hypot(scatter * median_error(float(len(seen))), wear_sd * middle))


def _pooled(
    samples: pl.DataFrame, column: str, parameter: str, bias_sd: float, *, wear: bool
) -> tuple[float, float, tuple[Level, ...]]:
    """A quantity's fleet value, its standard deviation, and its levels by operator and pack.

    With `wear` it is taken from each pack's first flights, and raised by what a machine has lost by then.
    """
    flights = samples.group_by(*FLIGHT_PACK).agg(pl.col(column).median(), pl.col("time_utc").min()).drop_nulls(column)
    by_pack = flights.sort(*PACK, "time_utc", "flight_id").group_by(PACK, maintain_order=True)
    packs = (by_pack.head(BLOCK_FLIGHTS).group_by(PACK, maintain_order=True) if wear else by_pack).agg(
        pl.col(column).median().alias("value"), pl.len().alias("n"), pl.col(column).std().alias("spread")
    )
    if not packs.height:
        return *PRIOR[parameter], ()
    random = pl.coalesce("spread", 0.05 * pl.col("value")) * median_error(pl.col("n"))
    error = (random**2 + (bias_sd * pl.col("value")) ** 2).sqrt()
    pooled, levels = levels_of(packs.with_columns(error_sd=error), parameter)
    if wear:
        return *_as_built(packs["value"].to_numpy(), 2.0 * ENTRY_WEAR, 2.0 * ENTRY_WEAR_SD), levels
    return pooled.fleet, pooled.fleet_sd, levels


def inlet_geometry(group_m3: float, group_sd_m3: float) -> dict[str, tuple[float, float]]:
    r"""Inlet area, eye diameter and blade angle from the group A D tan(beta) and a *prior* on the angle: value and sd.

    Notes
    -----
    The group is all that flow tells. With the angle from elsewhere and the annulus between hub and eye,
    :math:`A = \tfrac{\pi}{4} D^2 (1 - \nu^2)`, diameter and area follow; the angle comes back as it went in.
    """
    share = 0.25 * np.pi * (1.0 - HUB_RATIO**2)
    eye_m = float(np.cbrt(group_m3 / (share * np.tan(BLADE_ANGLE_RAD))))
    tangent_sd = BLADE_ANGLE_SD_RAD / (np.sin(BLADE_ANGLE_RAD) * np.cos(BLADE_ANGLE_RAD))
    eye_sd = float(np.hypot(group_sd_m3 / group_m3, tangent_sd)) / 3.0
    area_m2 = share * eye_m**2
    return {
        "cc_inlet_area_m2": (area_m2, 2.0 * eye_sd * area_m2),
        "cc_eye_diameter_m": (eye_m, eye_sd * eye_m),
        "cc_blade_angle_rad": (BLADE_ANGLE_RAD, BLADE_ANGLE_SD_RAD),
    }
