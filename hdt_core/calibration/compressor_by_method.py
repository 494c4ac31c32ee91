"""Estimate a compressor's design as built by the method that it names, block by block and pack by pack.

Equation (6) is estimated on each block of flights within which a machine hardly wears, flow group and efficiency on
each pack; what packs share is then drawn from these as from the closed form's (`compressor.fit_compressor`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.calibration.component_fit import (
    WITHOUT_ESTIMATE,
    declared_estimator,
    declared_prior,
    flight_by_flight,
    is_regular,
)
from hdt_core.calibration.diffuser_line import BlockRows, Line, regular_samples, reliable_share
from hdt_core.components import Component
from hdt_core.physics.compressor import COMPRESSION, COMPRESSOR
from hdt_core.physics.model import PhysicsModel
from hdt_core.records.keys import PACK
from hdt_core.robust import group_means

EQUATION_6 = ("cc_diameter_vda_intercept", "cc_diameter_vda_slope")


class Source(NamedTuple):
    """Model and output that determine a parameter of a pack; the column of `compressor_samples` that tells spikes."""

    model: PhysicsModel
    output: str
    column: str


SOURCES = {
    "cc_area_diameter_tan_beta_m3": Source(COMPRESSOR, "cc_flow_kg_s", "group_m3"),
    "cc_efficiency": Source(COMPRESSION, "cc_out_k", "efficiency"),
}


def compressor_inputs(samples: pl.DataFrame, middle_counts: float) -> pl.DataFrame:
    """Name the signals of `compressor_samples` as the declared models do, the diffuser in the middle where unknown."""
    return samples.with_columns(
        pl.col("vda_counts").cast(pl.Float64).fill_null(middle_counts),
        cc_in_k=pl.col("inlet_k"),
        cc_in_pa=pl.col("inlet_pa"),
        cc_out_pa=pl.col("exit_pa"),
        cc_out_k=pl.col("exit_k"),
        cc_pressure_ratio=pl.col("exit_pa") / pl.col("inlet_pa"),
    )


def line_by_method(samples: pl.DataFrame, rows: BlockRows, part: Component) -> Line | None:
    """Estimate equation (6) of every block, and the steepness that machines share.

    Parameters
    ----------
    samples : DataFrame
        Of `compressor_samples`.
    rows : BlockRows
        Of the same samples' diameters.
    part : Component
        The compressor, with its estimator.

    Returns
    -------
    Line or None
        As of `diffuser_line.fit_line`; a block's level is NaN where the method gives none. None where it gives none
        for any pack's first block.
    """
    block = pl.Series("flight_id", rows.block).cast(pl.String)
    inputs = compressor_inputs(regular_samples(samples, "diameter_m"), 0.0).with_columns(block)
    fits = _estimates(inputs, COMPRESSOR, EQUATION_6, "cc_out_pa", part)
    numbers = fits["flight_id"].cast(pl.Int64).to_numpy()
    intercept, slope, slope_sd = fits.select(*EQUATION_6, f"{EQUATION_6[1]}_sd").to_numpy().T
    centre = float(rows.x.mean())
    level = np.full(rows.blocks.height, np.nan)
    level[numbers] = intercept + slope * centre
    if not np.isfinite(level[rows.blocks["turn"].to_numpy() == 0]).any():
        return None
    weight = (level[numbers] / slope_sd) ** 2
    steepness = float(np.average(slope / level[numbers], weights=weight))
    of_block = group_means(rows.x[:, None], rows.block, np.ones(len(rows.x)))[0]
    reliable = reliable_share(rows.x - of_block[rows.block, 0])
    mean_level = float(np.nanmean(level))
    residual = rows.y - level[rows.block] * (1.0 + steepness * (rows.x - centre))
    steepness_sd = float(weight.sum() ** -0.5)
    return Line(mean_level * steepness / reliable, mean_level * steepness_sd / reliable, level, centre, residual)


def pack_values(samples: pl.DataFrame, parameter: str, part: Component) -> pl.DataFrame:
    """Estimate one of `SOURCES` of every pack from all its samples.

    Returns
    -------
    DataFrame
        `PACK`, `value`, `random_sd` and `n`, the number of flights; packs of which the method gives no estimate are
        absent.
    """
    source = SOURCES[parameter]
    rows = compressor_inputs(samples, 0.0).drop_nulls(source.column).filter(is_regular(source.column))
    counts = rows.group_by(PACK).agg(pl.col("flight_id").n_unique().alias("n"))
    whole = rows.with_columns(flight_id=pl.lit("all"))
    fits = _estimates(whole, source.model, [parameter], source.output, part)
    values = fits.select(*PACK, pl.col(parameter).alias("value"), pl.col(f"{parameter}_sd").alias("random_sd"))
    return values.join(counts, on=PACK, validate="1:1", maintain_order="left")


def _estimates(
    samples: pl.DataFrame, model: PhysicsModel, names: Sequence[str], output: str, part: Component
) -> pl.DataFrame:
    """Estimate parameters from all samples of one `flight_id`, from their declared prior; only what is an estimate."""
    fits = flight_by_flight(
        samples,
        model,
        names,
        outputs=[output],
        estimator=declared_estimator(part),
        prior=declared_prior(model, names),
    )
    numbers = [column for name in names for column in (name, f"{name}_sd")]
    is_number = pl.all_horizontal(pl.col(numbers).is_finite())
    return fits.filter(is_number & ~pl.col("status").is_in(WITHOUT_ESTIMATE))
