"""How each pack is now: what each flight alone says, and the track through all of them."""

import json

import polars as pl

from hdt_core.twin.dsm import Dsm
from hdt_core.twin.flights import estimate_flights
from hdt_core.twin.track import track
from pipelines.assets.stage import stage


def model_of(calibration_dsm: pl.DataFrame) -> Dsm:
    """The Digital System Model in service."""
    return Dsm.from_dict(json.loads(calibration_dsm["model"][0]))


@stage("twin_flights", group="twin")
def twin_flights(legs_samples: pl.DataFrame, calibration_dsm: pl.DataFrame) -> pl.DataFrame:
    """Health of each pack from one flight alone, by maximum likelihood, all flights of the run at once."""
    return estimate_flights(legs_samples, model_of(calibration_dsm))


@stage("twin_health", group="twin")
def twin_health(
    twin_flights: pl.DataFrame, raw_maintenance: pl.DataFrame, calibration_dsm: pl.DataFrame
) -> pl.DataFrame:
    """The Operational Digital Twin: health after each flight, from that flight and all before it."""
    return track(twin_flights, raw_maintenance, model_of(calibration_dsm))
