"""How each pack is now: what each flight alone says, and the track through all of them."""

import json

import polars as pl

from hdt_core.calibration.dsm import Dsm
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.tracking.track import TrackResult, track_on
from pipelines.assets.stage import stage
from pipelines.lineage import LINEAGE
from pipelines.partitions import PartitionScope
from pipelines.resources import Home


def model_of(calibration_dsm: pl.DataFrame) -> Dsm:
    """The Digital System Model in service."""
    return Dsm.from_dict(json.loads(calibration_dsm["model"][0]))


@stage
def twin_flights(legs_samples: pl.DataFrame, calibration_dsm: pl.DataFrame) -> pl.DataFrame:
    """Health of each pack from one flight alone, by maximum likelihood, all flights of the run at once."""
    return estimate_flights(legs_samples, model_of(calibration_dsm))


@stage
def twin_health(
    scope: PartitionScope,
    home: Home,
    twin_flights: pl.DataFrame,
    raw_maintenance: pl.DataFrame,
    calibration_dsm: pl.DataFrame,
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """The Operational Digital Twin: health after each flight, from that flight and all before it.

    It goes on from the last checkpoint before what is new; a checkpoint says which flights it has seen.
    """
    known = TrackResult(*(scope.read_table(home.store, table) for table in ("twin_health", "twin_checkpoints")))
    return track_on(twin_flights, raw_maintenance, model_of(calibration_dsm), known, LINEAGE["twin_health"].code)
