"""Track compressor health flight by flight: effective diameter, and filtered losses of diameter and efficiency."""

import numpy as np
import polars as pl

from hdt_core.calibration.dsm import Dsm
from hdt_core.components.compressor import CC
from hdt_core.physics.model import Array, declared
from hdt_core.records.packs import split_packs
from hdt_core.records.renewals import log_flags
from hdt_core.robust import median_error
from hdt_core.tracking.flight_panel import FILTERED, health_rows

EFFICIENCY_SD, DIAMETER_SD_LN = 0.006, 0.02
"""Scatter of a flight about the machine's state, for packs too young to show their own."""
EFFICIENCY, DIAMETER = (CC.model.param(name) for name in ("cc_efficiency_loss", "cc_diameter_loss"))
ENTRY_LOSS_SD = 0.015
PROBE_SD, SAMPLE_SD = 0.0025, 0.003
"""Of a diameter, as a share of it: calibration of the probes (half a per cent of head), and noise of one sample."""


def compressor_parameters(flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm) -> pl.DataFrame:
    """Estimate `cc_effective_diameter_m`, `cc_efficiency_loss` and `cc_diameter_loss` of every row, in long form."""
    diameter = (flights["diameter_m"], _diameter_sd(flights))
    efficiency = np.log(dsm.compressor.efficiency / _positive(flights["efficiency"]))
    built_sd = dsm.compressor.efficiency_sd / dsm.compressor.efficiency
    level_sd = float(np.hypot(declared(EFFICIENCY.unit_sd), built_sd))
    renewals = log_flags(flights, maintenance, "CC")[1]
    efficiency_loss = filter_loss(flights, efficiency, renewals, EFFICIENCY_SD, level_sd, EFFICIENCY.drift)
    ln_diameter = np.log(_positive(flights["expected_diameter_m"]) / _positive(flights["diameter_m"]))
    unit_sd = declared(DIAMETER.unit_sd)
    diameter_loss = filter_loss(flights, ln_diameter, renewals, DIAMETER_SD_LN, unit_sd, DIAMETER.drift)
    tracks = (
        ("cc_effective_diameter_m", "m", "closed_form", *diameter),
        ("cc_efficiency_loss", "-", FILTERED, *efficiency_loss),
        ("cc_diameter_loss", "-", FILTERED, *diameter_loss),
    )
    return pl.concat([_long(flights, *track) for track in tracks])


def _positive(column: pl.Series) -> Array:
    values = column.to_numpy().astype(float)
    return np.where(values > 0.0, values, np.nan)


def _diameter_sd(flights: pl.DataFrame) -> pl.Series:
    """Compute the sd of the flight's median; scatter from sample to sample is mostly the machine's, and no error."""
    noise = SAMPLE_SD * median_error(np.maximum(flights["cc_n_samples"].to_numpy(), 1.0))
    return flights["diameter_m"] * pl.Series(np.hypot(PROBE_SD, noise))


def filter_loss(
    flights: pl.DataFrame, ln_ratio: Array, renewals: Array, scatter: float, level_sd: float, step_sd: float
) -> tuple[pl.Series, pl.Series]:
    """Filter loss against the pack's own first level, with two states: level of machine and sensors, and loss.

    Parameters
    ----------
    flights : DataFrame
        In order: see `keys.IN_ORDER`.
    ln_ratio : array
        ln of expected over measured, NaN where none. (n,)
    renewals : array
        Above 0 on the first flight of another machine. (n,)
    """
    loss, sd = np.full(len(ln_ratio), np.nan), np.full(len(ln_ratio), np.nan)
    for rows in split_packs(flights):
        loss[rows], sd[rows] = _filter(ln_ratio[rows], renewals[rows], scatter, level_sd, step_sd)
    return pl.Series(loss).fill_nan(None), pl.Series(sd).fill_nan(None)


def _filter(ln_ratio: Array, renewals: Array, scatter: float, level_sd: float, step_sd: float) -> tuple[Array, Array]:
    loss, sd = np.full(len(ln_ratio), np.nan), np.full(len(ln_ratio), np.nan)
    x, w = 0.0, 0.005  # level, loss
    pxx, pxw, pww = level_sd**2, 0.0, ENTRY_LOSS_SD**2
    has_started = False
    for k, value in enumerate(ln_ratio):
        if renewals[k]:
            x, w, pxx, pxw, pww = 0.0, 0.003, level_sd**2, 0.0, 0.005**2
        pww += step_sd**2
        if np.isfinite(value):
            has_started = True
            variance = pxx + 2.0 * pxw + pww + scatter**2
            residual = value - x - w
            # far off is more likely a bad flight than a bad machine: it counts less, not nothing
            variance *= max(1.0, abs(residual) / (3.0 * np.sqrt(variance))) ** 2
            kx, kw = (pxx + pxw) / variance, (pxw + pww) / variance
            x, w = x + kx * residual, w + kw * residual
            pxx, pxw, pww = pxx - kx * (pxx + pxw), pxw - kx * (pxw + pww), pww - kw * (pxw + pww)
        if has_started:
            loss[k], sd[k] = 1.0 - np.exp(-w), np.exp(-w) * np.sqrt(max(pww, 0.0))
    return loss, sd


def _long(flights: pl.DataFrame, name: str, unit: str, estimator: str, value: pl.Series, sd: pl.Series) -> pl.DataFrame:
    known_status = pl.when(pl.col("cc_n_samples") > 0).then(pl.lit("ok")).otherwise(pl.lit("predicted"))
    status = pl.when(value.is_null()).then(pl.lit("not_recorded")).otherwise(known_status)
    return health_rows(flights, ("CC", name, unit, estimator), value, sd.set(value.is_null(), None), status)
