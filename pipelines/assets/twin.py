"""Estimate each pack's health from one flight, track every component through all, compare with sensor and model."""

import json

import polars as pl

from hdt_core.calibration.dsm import Dsm
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.health.residuals import residuals as compare
from hdt_core.tracking.loss_filter import TrackResult, join_tracks
from hdt_core.tracking.track import track
from pipelines.assets.components import track_components
from pipelines.assets.stage import stage
from pipelines.lineage import LINEAGE
from pipelines.partitions import PartitionScope
from pipelines.resources import Home


def model_of(calibration_dsm: pl.DataFrame) -> Dsm:
    """Read the Digital System Model in service."""
    return Dsm.from_dict(json.loads(calibration_dsm["model"][0]))


@stage
def twin_flights(legs_samples: pl.DataFrame, calibration_dsm: pl.DataFrame) -> pl.DataFrame:
    """Estimate health of each pack from one flight alone by maximum likelihood, for all flights of the run."""
    return estimate_flights(legs_samples, model_of(calibration_dsm))


@stage
def twin_health(
    scope: PartitionScope,
    home: Home,
    twin_flights: pl.DataFrame,
    raw_maintenance: pl.DataFrame,
    calibration_dsm: pl.DataFrame,
    raw_components: pl.DataFrame,
    legs_components: pl.DataFrame,
    calibration_components: pl.DataFrame,
) -> tuple[pl.DataFrame, pl.DataFrame, pl.DataFrame]:
    """Track the Operational Digital Twin: each component's health after a flight, from that flight and all before it.

    It continues from the last checkpoint before the new flights; a checkpoint lists the flights it includes.
    """
    stored = TrackResult(*(scope.read_table(home.store, table) for table in ("twin_health", "twin_checkpoints")))
    inputs, code = (raw_components, legs_components, calibration_components), LINEAGE["twin_health"].code
    components, residuals = track_components(*inputs, raw_maintenance, home, stored, code)
    tracks = [components]
    if twin_flights.height:
        tracks.append(track(twin_flights, raw_maintenance, model_of(calibration_dsm), stored, code))
    return *join_tracks(tracks), residuals


@stage
def residuals(legs_samples: pl.DataFrame, twin_flights: pl.DataFrame, calibration_dsm: pl.DataFrame) -> pl.DataFrame:
    """Compute sensor minus model, model minus twin and sensor minus twin, per flight and signal."""
    return compare(legs_samples, twin_flights, model_of(calibration_dsm))
