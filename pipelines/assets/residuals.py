"""Residuals between sensor, model and twin."""

import polars as pl

from hdt_core.health.residuals import residuals as compare
from pipelines.assets.stage import stage
from pipelines.assets.twin import model_of


@stage
def residuals(legs_samples: pl.DataFrame, twin_flights: pl.DataFrame, calibration_dsm: pl.DataFrame) -> pl.DataFrame:
    """Compute sensor minus model, model minus twin and sensor minus twin, per flight and signal."""
    return compare(legs_samples, twin_flights, model_of(calibration_dsm))
