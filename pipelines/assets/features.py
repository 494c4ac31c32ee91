"""What the differences mean: features of each pack after each flight, and the alerts they raise."""

import polars as pl

from hdt_core.health.alerts import raise_alerts
from hdt_core.health.features import features as describe
from hdt_core.health.witnesses import witnesses
from pipelines.assets.stage import stage


@stage("features", group="features")
def features(
    twin_health: pl.DataFrame,
    residuals: pl.DataFrame,
    legs_admitted: pl.DataFrame,
    raw_maintenance: pl.DataFrame,
    twin_flights: pl.DataFrame,
    legs_samples: pl.DataFrame,
) -> pl.DataFrame:
    """Health, residuals and their trends, virtual sensors, witnesses for door and sensors, by flight and pack."""
    seen = witnesses(legs_samples)
    return describe(twin_health, residuals, legs_admitted, raw_maintenance, twin_flights=twin_flights, witnesses=seen)


@stage("features_alerts", group="features")
def features_alerts(features: pl.DataFrame, twin_health: pl.DataFrame, raw_maintenance: pl.DataFrame) -> pl.DataFrame:
    """Cases that want a person: what moved, since when, what else could explain it, what to do."""
    return raise_alerts(features, twin_health, raw_maintenance)
