"""Track compressor health flight by flight: effective diameter, and filtered losses of diameter and efficiency."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import polars as pl

from hdt_core.calibration.compressor_fit import ENTRY_UNIT_SD
from hdt_core.calibration.dsm import Dsm
from hdt_core.calibration.initial_wear import EntryWear
from hdt_core.components import Component
from hdt_core.components.compressor import CC
from hdt_core.physics.model import Array, Param
from hdt_core.records.keys import PACK
from hdt_core.robust import median_error
from hdt_core.tracking.component import DesignOffset, scatter_by_segment, wear_settings
from hdt_core.tracking.flight_panel import FILTERED, health_rows
from hdt_core.tracking.loss_filter import Loss, TrackResult, track_loss
from hdt_core.tracking.wear_model import FAULT_CHANCE

EFFICIENCY_SD, DIAMETER_SD_LN = 0.006, 0.02
"""Scatter of a flight about the machine's state, for packs too young to show their own."""
ENTRY = (EntryWear(0.85, 0.0033, 0.025, True), EntryWear(0.15, 0.083, 0.05, False))
"""Machines at entry lose little for most of their life; wear where failure is the exchanger's."""
PROBE_SD, SAMPLE_SD = 0.0025, 0.003
"""Of a diameter, as a share of it: calibration of the probes (half a per cent of head), and noise of one sample."""


def track_compressor(
    flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm, previous: TrackResult | None = None, seal: str = ""
) -> Iterator[TrackResult]:
    """Track `cc_efficiency_loss` and `cc_diameter_loss` of each pack from its first flight with an estimate on.

    Losses count from the fleet's machine as built, so a better one has a negative loss.
    """
    efficiency = np.log(_positive(flights["efficiency"]) / dsm.compressor.efficiency)
    diameter = np.log(_positive(flights["diameter_m"]) / _positive(flights["expected_diameter_m"]))
    built_sd = dsm.compressor.efficiency_sd / dsm.compressor.efficiency
    # the effective diameter is the true one times the root of slip times efficiency
    weak = replace(CC, limit=replace(CC.limit, mean=1.0 - float(np.sqrt(1.0 - CC.limit.mean))))
    for component, name, ln_ratio, level_sd, usual_sd in (
        (CC, "cc_efficiency_loss", efficiency, built_sd, EFFICIENCY_SD),
        (weak, "cc_diameter_loss", diameter, 0.0, DIAMETER_SD_LN),
    ):
        estimates = flights.select(PACK).with_columns(n=pl.Series(np.isfinite(ln_ratio)).cast(pl.Int32))
        has_begun = estimates.select(pl.col("n").cum_sum().over(PACK) > 0)[:, 0]
        own, param = flights.filter(has_begun), CC.model.param(name)
        loss = _loss(own, component, param, ln_ratio[has_begun.to_numpy()], usual_sd)
        # the level's error is all machines' alike, and wear at entry was weighed in it: a pack's own must not shrink it
        loss = loss._replace(more_variance=(np.full(own.height, level_sd**2),))
        result = track_loss(own, maintenance, loss, previous, seal)
        before, names = flights.filter(~has_begun), (CC.code, name, param.unit, FILTERED)
        nothing = pl.Series([None] * before.height, dtype=pl.Float64)
        not_recorded = health_rows(before, names, nothing, nothing, pl.lit("not_recorded"))
        yield result._replace(health=pl.concat([not_recorded, result.health]))


def _loss(flights: pl.DataFrame, component: Component, param: Param, ln_ratio: Array, usual_sd: float) -> Loss:
    size, settings = wear_settings(component, param, DesignOffset(0.0, 0.0))
    ratio = ln_ratio / size
    scatter = scatter_by_segment(flights, ratio, np.zeros_like(ratio), usual_sd / size)
    variance = np.where(np.isfinite(ratio), scatter**2, 1.0)
    status = pl.when(pl.col("cc_n_samples") > 0).then(pl.lit("ok")).otherwise(pl.lit("predicted"))
    # a step of its probes is no rarer than one of the exchanger's
    settings = settings._replace(
        entries=ENTRY, fault_chance=FAULT_CHANCE, truncated=False, offset_sd=ENTRY_UNIT_SD / size
    )
    return Loss(component, param, size, settings, (ratio, variance, np.ones_like(ratio)), status)


def effective_diameter(flights: pl.DataFrame) -> pl.DataFrame:
    """Build rows of `cc_effective_diameter_m`.

    Scatter from sample to sample is mostly the machine's, and no error of the flight's median.
    """
    noise = SAMPLE_SD * median_error(np.maximum(flights["cc_n_samples"].to_numpy(), 1.0))
    value = flights["diameter_m"]
    sd = (value * pl.Series(np.hypot(PROBE_SD, noise))).set(value.is_null(), None)
    known_status = pl.when(pl.col("cc_n_samples") > 0).then(pl.lit("ok")).otherwise(pl.lit("predicted"))
    status = pl.when(value.is_null()).then(pl.lit("not_recorded")).otherwise(known_status)
    return health_rows(flights, (CC.code, "cc_effective_diameter_m", "m", "closed_form"), value, sd, status)


def _positive(column: pl.Series) -> Array:
    values = column.to_numpy().astype(float)
    return np.where(values > 0.0, values, np.nan)
