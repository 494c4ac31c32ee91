"""What a new user sees first: the fleet that `hdt simulate` writes unasked has something to show."""

import warnings

import polars as pl

from benchmarks.fleets import fly
from hdt_core.simulate.design import FleetSettings
from pipelines.cli.make import DEMO


def test_its_last_night_has_open_alerts_and_a_history():
    size = {name: value for name, value in DEMO.items() if name != "seed"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # samples of a pack that is off, as in every night
        frames = fly(DEMO["seed"], FleetSettings(**size))
    still = frames["alerts"].filter(pl.col("closed_at").is_null(), component="HX")
    assert still.filter(severity="high").height >= 1
    assert still["tail"].n_unique() >= 1
    assert frames["lives"].filter("failed").height >= 1, "a message that a replacement answered"
    loss = frames["features"].sort("departed_at").group_by("tail", "pack").last().get_column("hx_fouling")
    assert loss.max() > 0.3
