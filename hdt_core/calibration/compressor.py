"""Compute a compressor's effective diameter, flow group and efficiency, and fit them as built to nominal flights.

As built: equation (6) and its rivals, the group of equations (2)-(4), the efficiency. A diameter is a flight's own
level times a curve of the diffuser's position that the fleet shares.
"""

from dataclasses import dataclass, replace

import numpy as np
import polars as pl
from scipy.special import log_ndtr

from hdt_core.calibration.arrays import LEVEL_M, Array
from hdt_core.calibration.component_fit import CLOSED_FORM, has_closed_form
from hdt_core.calibration.compressor_by_method import line_by_method, pack_values
from hdt_core.calibration.diffuser_line import BLOCK_FLIGHTS, FormFit, compare_forms, fit_line, rows_of
from hdt_core.calibration.pooling import PooledLevel, levels_of
from hdt_core.calibration.sensor_biases import CC_FLOW_BIAS_SD
from hdt_core.components import Component
from hdt_core.components.pack import CC
from hdt_core.physics.compressor import (
    area_diameter_tan_beta_m3,
    effective_diameter_m,
    expected_diameter_m,
    group_at_m3,
    isentropic_efficiency,
)
from hdt_core.physics.model import declared
from hdt_core.records.keys import FLIGHT_PACK, PACK
from hdt_core.robust import median_error, spread, spread_expr

PRIOR = {p.name: (p.nominal, declared(p.sd)) for p in CC.model.free("design")}
"""The paper's law with a wide band, as the component declares it."""
BLADE_ANGLE_RAD, BLADE_ANGLE_SD_RAD, HUB_RATIO = float(np.deg2rad(36.0)), float(np.deg2rad(3.0)), 0.4
"""Angle from tangential and hub to eye diameter of inducers of this kind: assumed, not recorded."""
MIN_POINTS = 30
ENTRY_WEAR, ENTRY_WEAR_SD_LN, ENTRY_UNIT_SD = 0.003, 1.5, 0.02
"""Mean ln loss of diameter of a fleet's compressors at entry, how well it is known, and the sd over units, sensors
included. Assumed, not recorded; efficiency loses twice as much."""
FAULTY_ABOVE = 0.1
"""Ln above the fleet's middle from which a level is that of a faulty sensor: five of `ENTRY_UNIT_SD`. No machine is
built so much better than its sisters."""
SCORES, LN_ABOVE = np.linspace(-2.5, 2.5, 31), np.linspace(-0.1, 0.25, 351)
PROBE_SD_LN = 0.003
"""Calibration error of an efficiency, which no number of flights takes out of one pack."""
STEADY_SAMPLES = 5


def compressor_samples(cruise: pl.DataFrame, corrections: pl.DataFrame) -> pl.DataFrame:
    """Add `diameter_m` (equation 5), `group_m3` (equations 2-4), `efficiency` and what they rest on, `inlet_k`,
    `inlet_pa`, `exit_k` and `exit_pa`, to cruise samples; null where not recorded."""
    cruise_rows = cruise.sort(*FLIGHT_PACK, "time_utc")
    rows = _average_levels(cruise_rows).join(corrections, on=PACK, how="left", maintain_order="left", validate="m:1")
    s = {
        c: rows[c].to_numpy().astype(float)
        for c in ("cc_in_k", "cc_in_pa", "cc_out_k", "cc_out_pa", "cc_speed_rad_s", "cc_flow_kg_s")
    }
    inlet_k = s["cc_in_k"] - rows["inlet_bias_k"].fill_null(0.0).to_numpy()
    exit_pa = s["cc_out_pa"] * np.exp(-rows["exit_bias_ln"].fill_null(0.0).to_numpy())
    inlet_pa = s["cc_in_pa"] * np.exp(-rows["inlet_bias_ln"].fill_null(0.0).to_numpy())
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        values = {
            "inlet_k": inlet_k,
            "inlet_pa": inlet_pa,
            "exit_k": s["cc_out_k"],
            "exit_pa": exit_pa,
            "diameter_m": effective_diameter_m(inlet_pa, exit_pa, inlet_k, s["cc_speed_rad_s"]),
            "group_m3": area_diameter_tan_beta_m3(s["cc_flow_kg_s"], inlet_pa, inlet_k, s["cc_speed_rad_s"]),
            "efficiency": isentropic_efficiency(inlet_pa, exit_pa, inlet_k, s["cc_out_k"]),
        }
    valid = {name: np.where(np.isfinite(v) & (v > 0.0), v, np.nan) for name, v in values.items()}
    return cruise_rows.with_columns(pl.Series(name, v).fill_nan(None) for name, v in valid.items())


def _average_levels(cruise: pl.DataFrame) -> pl.DataFrame:
    """Average pressures and temperatures along a cruise level, the inlet's from the air data plus the flight's offset.

    In a cruise the states of the air move slowly while speed and diffuser vary from one sample to the next: a flight's
    median diameter is one sample's, and should not have that sample's noise. Nor must a missing reading cost the
    sample.
    """
    above_k = (pl.col("cc_in_k") - pl.col("tat_k")).median().over(FLIGHT_PACK)
    ratio = (pl.col("cc_in_pa") / pl.col("total_pressure_pa")).median().over(FLIGHT_PACK)
    level = (pl.col("altitude_m") / LEVEL_M).round().fill_null(strategy="forward").alias("_level")
    along = [*FLIGHT_PACK, "_level"]
    return (
        cruise.with_columns(
            level,
            pl.coalesce(pl.col("tat_k") + above_k, "cc_in_k").alias("cc_in_k"),
            pl.coalesce(pl.col("total_pressure_pa") * ratio, "cc_in_pa").alias("cc_in_pa"),
        )
        .with_columns(
            pl.col(c).rolling_mean(STEADY_SAMPLES, center=True, min_samples=1).over(along)
            for c in ("cc_in_k", "cc_in_pa", "cc_out_pa", "cc_out_k")
        )
        .drop("_level")
    )


def compressor_flights(samples: pl.DataFrame) -> pl.DataFrame:
    """Compute medians of each flight and pack, with the standard error of each."""
    columns = ("diameter_m", "group_m3", "efficiency", "vda_counts")

    def error(name: str) -> pl.Expr:
        sd = spread_expr(pl.col(name) - pl.col(name).median())
        return (sd * median_error(pl.col(name).count())).alias(f"{name}_se")

    return samples.group_by(FLIGHT_PACK).agg(
        *(pl.col(c).median() for c in columns),
        *(error(c) for c in columns[:3]),
        pl.col("diameter_m").count().alias("cc_n_samples"),
    )


@dataclass(frozen=True, slots=True)
class CompressorFit:
    """Equation (6), the group of equations (2)-(4) and the efficiency as built, each with its standard deviation.

    `vda_counts` is the middle of the diffuser's positions, where the group is stated; `vda_widest_counts` the widest
    on record, as far as its map is known; the map has no slope where it is not known at all.
    """

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
    group_slope_m3_per_count: float
    group_slope_sd_m3_per_count: float
    vda_widest_counts: float
    forms: tuple[FormFit, ...] = ()
    levels: tuple[PooledLevel, ...] = ()
    method: str = CC.estimator

    def diameter_m(self, vda_counts: Array) -> Array:
        """Compute the effective diameter of a sound machine with the diffuser at these positions. [m]"""
        return expected_diameter_m(vda_counts, np.asarray(self.intercept_m), np.asarray(self.slope_m_per_count))

    def group_at_m3(self, vda_counts: Array) -> Array:
        """Compute A D tan(beta) with the diffuser at these positions. [m3]"""
        law = map(np.asarray, (self.group_m3, self.vda_counts, self.group_slope_m3_per_count))
        return group_at_m3(vda_counts, *law)

    def position_counts(self, group_m3: Array) -> Array:
        """Compute positions from the group, the inverse of `group_at_m3`. [count]"""
        return self.vda_counts + (group_m3 - self.group_m3) / self.group_slope_m3_per_count


def fit_compressor(samples: pl.DataFrame, part: Component = CC) -> CompressorFit:
    """Characterise the compressor over the baseline.

    Parameters
    ----------
    samples : DataFrame
        Of `compressor_samples`, baseline flights only.
    part : Component
        The compressor, with the estimator of its design.

    Returns
    -------
    CompressorFit
        The paper's law with a wide band where the records hold too little. Where the part's method estimates no pack,
        that of the closed form, which `method` then names.

    Notes
    -----
    The diffuser's reading is noisy, which flattens a slope by the share of noise in its variance; the slope is raised
    by as much. Levels are those of machines at entry, raised by their expected wear.
    """
    rows = rows_of(samples, "diameter_m")
    group, group_sd, group_levels = _pool(
        samples, "group_m3", "cc_area_diameter_tan_beta_m3", CC_FLOW_BIAS_SD, part, wear=False
    )
    efficiency, efficiency_sd, efficiency_levels = _pool(
        samples, "efficiency", "cc_efficiency", PROBE_SD_LN, part, wear=True
    )
    flights = samples.select(FLIGHT_PACK).unique().height
    if len(rows.x) < MIN_POINTS or flights == samples.select(PACK).unique().height:
        return _prior(flights)  # one flight a pack: nothing to compare within a machine
    line = fit_line(rows) if has_closed_form(part) else line_by_method(samples, rows, part)
    if line is None:
        return fit_compressor(samples, replace(part, estimator=CLOSED_FORM))
    levels = pl.DataFrame({"level": line.level}).hstack(rows.blocks)
    first_levels = levels.filter(turn=0).filter(pl.col("level").is_finite())
    as_built, as_built_sd = _as_built(first_levels["level"].to_numpy(), ENTRY_WEAR)
    # the slope is proportional to the level, so it is raised likewise
    slope = line.slope * as_built / float(np.nanmean(line.level))
    slope_sd = float(np.hypot(line.slope_sd, slope * as_built_sd / as_built))
    group_slope, group_slope_sd = _group_slope(samples)
    form_fits = compare_forms(rows)
    linear = form_fits[1] if form_fits else None
    return CompressorFit(
        intercept_m=as_built - slope * line.centre, intercept_sd_m=float(np.hypot(as_built_sd, slope_sd * line.centre)),
        slope_m_per_count=slope, slope_sd_m_per_count=slope_sd,
        scatter_m=spread(line.residual),
        mae_m=linear.cv_mae_m if linear else float(np.nanmean(np.abs(line.residual))),
        r_squared=linear.r_squared if linear else 0.0,
        group_m3=group, group_sd_m3=group_sd,
        efficiency=efficiency, efficiency_sd=efficiency_sd,
        vda_counts=line.centre, vda_widest_counts=float(rows.x.max()),
        n_flights=flights,
        group_slope_m3_per_count=group_slope, group_slope_sd_m3_per_count=group_slope_sd,
        forms=form_fits, levels=(*group_levels, *efficiency_levels), method=part.estimator,
    )  # fmt: skip


def _prior(flights: int) -> CompressorFit:
    """Return the paper's equation (6) with a wide band, where the fleet's own records hold too little."""
    return CompressorFit(
        *PRIOR["cc_diameter_vda_intercept"], *PRIOR["cc_diameter_vda_slope"], 0.0055, 0.0055, 0.0,
        *PRIOR["cc_area_diameter_tan_beta_m3"], *PRIOR["cc_efficiency"], 400.0, flights, 0.0, 0.0, 0.0,
    )  # fmt: skip


def _group_slope(samples: pl.DataFrame) -> tuple[float, float]:
    """Fit the group's slope over the diffuser's position, and its standard error; 0 with too few points. [m3/count]"""
    rows = rows_of(samples, "group_m3")
    if len(rows.x) < MIN_POINTS:
        return 0.0, 0.0
    line = fit_line(rows)
    return line.slope, line.slope_sd


def _as_built(levels: Array, wear: float) -> tuple[float, float]:
    """Estimate the level as built from machines a little worn, and its standard error.

    Wear at entry is exponential; its mean, about `wear`, is integrated over, for a fleet shows it by its spread. Levels
    of faulty sensors do not count: one alone would make the whole fleet worn.
    """
    ln_levels = np.log(levels)
    ln_levels = ln_levels[ln_levels - np.median(ln_levels) < FAULTY_ABOVE]
    level = float(np.median(ln_levels)) + LN_ABOVE
    loss_sds = (level[:, None] - ln_levels) / ENTRY_UNIT_SD
    rate = ENTRY_UNIT_SD / (wear * np.exp(ENTRY_WEAR_SD_LN * SCORES))[:, None, None]
    log_density = np.log(rate) + 0.5 * rate**2 - rate * loss_sds + log_ndtr(loss_sds - rate)
    log = log_density.sum(axis=2) - 0.5 * SCORES[:, None] ** 2
    weight = np.exp(log - log.max()).sum(axis=0)
    middle = float(np.average(level, weights=weight))
    sd = float(np.sqrt(np.average((level - middle) ** 2, weights=weight)))
    return float(np.exp(middle)), float(np.exp(middle) * sd)


def _pool(
    samples: pl.DataFrame, column: str, parameter: str, bias_sd: float, part: Component = CC, *, wear: bool
) -> tuple[float, float, tuple[PooledLevel, ...]]:
    """Pool a quantity: fleet value, standard deviation, and levels by operator and pack.

    With `wear` it is taken from each pack's first flights and raised by the expected wear at entry.
    """
    flights = samples.group_by(*FLIGHT_PACK).agg(pl.col(column).median(), pl.col("time_utc").min()).drop_nulls(column)
    flights = flights.sort(*PACK, "time_utc", "flight_id")
    if wear:
        flights = flights.group_by(PACK, maintain_order=True).head(BLOCK_FLIGHTS)
    if has_closed_form(part):
        packs = flights.group_by(PACK, maintain_order=True).agg(
            pl.col(column).median().alias("value"), pl.len().alias("n"), pl.col(column).std().alias("spread")
        )
        random_sd = pl.coalesce("spread", 0.05 * pl.col("value")) * median_error(pl.col("n"))
        packs = packs.with_columns(random_sd=random_sd)
    else:
        packs = pack_values(samples.join(flights, on=FLIGHT_PACK, how="semi"), parameter, part)
    if not packs.height:
        return *PRIOR[parameter], ()
    error = (pl.col("random_sd") ** 2 + (bias_sd * pl.col("value")) ** 2).sqrt()
    pool, levels = levels_of(packs.with_columns(error_sd=error), parameter)
    if wear:
        return *_as_built(packs["value"].to_numpy(), 2.0 * ENTRY_WEAR), levels
    return pool.fleet, pool.fleet_sd, levels


def inlet_geometry(group_m3: float, group_sd_m3: float) -> dict[str, tuple[float, float]]:
    r"""Compute inlet area, eye diameter and blade angle from the group and a *prior* on the angle: value and sd.

    Notes
    -----
    Flow determines the group alone. With the angle given and the annulus between hub and eye,
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
