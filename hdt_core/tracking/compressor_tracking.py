"""Compressor health flight by flight: effective diameter as seen, losses of diameter and efficiency filtered."""

import numpy as np
import polars as pl

from hdt_core.calibration.dsm import Dsm
from hdt_core.components.compressor import CC
from hdt_core.physics.model import Array, declared
from hdt_core.records.keys import PACK
from hdt_core.records.renewals import log_flags
from hdt_core.robust import median_error
from hdt_core.tracking.flight_panel import health_rows

EFFICIENCY_SD, DIAMETER_SD_LN = 0.006, 0.02
"""Scatter of a flight about the machine's state, for packs too young to show their own."""
EFFICIENCY, DIAMETER = (CC.model.param(name) for name in ("cc_efficiency_loss", "cc_diameter_loss"))
ENTRY_LOSS_SD = 0.015
PROBE_SD, SAMPLE_SD = 0.0025, 0.003
"""Of a diameter, as a share of it: calibration of the probes (half a per cent of head), and noise of one sample."""


def compressor_parameters(flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm) -> pl.DataFrame:
    """`cc_effective_diameter_m`, `cc_efficiency_loss`, `cc_diameter_loss` of every row of `flights`, in long form."""
    diameter = _long(
        flights, "cc_effective_diameter_m", flights["diameter_m"], _diameter_sd(flights), "m", "closed_form"
    )
    efficiency = np.log(dsm.compressor.efficiency / _positive(flights["efficiency"]))
    built_sd = dsm.compressor.efficiency_sd / dsm.compressor.efficiency
    level_sd = float(np.hypot(declared(EFFICIENCY.unit_sd), built_sd))
    renewed = log_flags(flights, maintenance, "CC")[1]
    efficiency_loss, efficiency_sd = filtered_loss(
        flights, efficiency, renewed, EFFICIENCY_SD, level_sd, EFFICIENCY.drift
    )
    ln_diameter = np.log(_positive(flights["expected_diameter_m"]) / _positive(flights["diameter_m"]))
    diameter_loss, diameter_sd = filtered_loss(
        flights, ln_diameter, renewed, DIAMETER_SD_LN, declared(DIAMETER.unit_sd), DIAMETER.drift
    )
    return pl.concat(
        [
            diameter,
            _long(flights, "cc_efficiency_loss", efficiency_loss, efficiency_sd, "-", "kalman_filtered"),
            _long(flights, "cc_diameter_loss", diameter_loss, diameter_sd, "-", "kalman_filtered"),
        ]
    )


def _positive(column: pl.Series) -> Array:
    values = column.to_numpy().astype(float)
    return np.where(values > 0.0, values, np.nan)


def _diameter_sd(flights: pl.DataFrame) -> pl.Series:
    """Of the flight's median: what scatters from sample to sample is mostly the machine itself, and no error."""
    noise = SAMPLE_SD * median_error(np.maximum(flights["cc_n_samples"].to_numpy(), 1.0))
    return flights["diameter_m"] * pl.Series(np.hypot(PROBE_SD, noise))


def filtered_loss(
    flights: pl.DataFrame, ln_ratio: Array, renewed: Array, scatter: float, level_sd: float, step_sd: float
) -> tuple[pl.Series, pl.Series]:
    """Loss against the pack's own level as first met, by a two-state filter (level of machine and sensors, loss).

    Parameters
    ----------
    flights : DataFrame
        In order: see `keys.IN_ORDER`.
    ln_ratio : array
        ln of expected over measured, NaN where none. (n,)
    renewed : array
        Above 0 on the first flight of another machine. (n,)
    """
    pack = flights.select(pl.struct(PACK).rank("dense"))[:, 0].to_numpy().astype(np.int64)
    loss, sd = np.full(len(ln_ratio), np.nan), np.full(len(ln_ratio), np.nan)
    for rows in np.split(np.arange(len(ln_ratio)), np.flatnonzero(np.diff(pack)) + 1) if len(ln_ratio) else []:
        loss[rows], sd[rows] = _filter(ln_ratio[rows], renewed[rows], scatter, level_sd, step_sd)
    return pl.Series(loss).fill_nan(None), pl.Series(sd).fill_nan(None)


def _filter(ln_ratio: Array, renewed: Array, scatter: float, level_sd: float, step_sd: float) -> tuple[Array, Array]:
    loss, sd = np.full(len(ln_ratio), np.nan), np.full(len(ln_ratio), np.nan)
    x, w = 0.0, 0.005  # level, loss
    pxx, pxw, pww = level_sd**2, 0.0, ENTRY_LOSS_SD**2
    has_started = False
    for k, value in enumerate(ln_ratio):
        if renewed[k]:
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


def _long(flights: pl.DataFrame, name: str, value: pl.Series, sd: pl.Series, unit: str, estimator: str) -> pl.DataFrame:
    measured = pl.when(pl.col("cc_n_samples") > 0).then(pl.lit("ok")).otherwise(pl.lit("predicted"))
    status = pl.when(value.is_null()).then(pl.lit("not_recorded")).otherwise(measured)
    return health_rows(flights, ("CC", name, unit, estimator), value, sd.set(value.is_null(), None), status)
