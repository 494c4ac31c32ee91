"""How the aircraft were built: the Digital System Model, from the commissioning window of each tail."""

import json

import polars as pl

from hdt_core.flight.admission import admit
from hdt_core.twin.calibrate import calibrate
from hdt_core.twin.flights import estimate_flights
from hdt_core.twin.parameters import design_parameters
from pipelines.assets.stage import Shown, stage
from pipelines.baseline import baseline_cells, baseline_records
from pipelines.plots import calibration_metadata
from pipelines.resources import Home


@stage(
    "calibration_dsm",
    "calibration_design",
    group="calibration",
    after=("legs_samples", "legs_verdicts", "raw_maintenance", "raw_messages"),
)
def calibration(home: Home) -> Shown:
    """Design parameters and nominal health of fleet, operator and tail, estimated together from nominal legs."""
    store, cells = home.store, baseline_cells(home.ledger)
    within = pl.col("flight_id").is_in(cells["flight_id"].implode())
    samples, verdicts = (store.scan(t).filter(within).collect() for t in ("legs_samples", "legs_verdicts"))
    maintenance, messages = (baseline_records(store, t, cells) for t in ("raw_maintenance", "raw_messages"))
    dsm = calibrate(samples, admit(verdicts, samples, maintenance, messages), maintenance)
    model = {"dsm_version": [dsm.dsm_version], "model": [json.dumps(dsm.to_dict())], "n_flights": [dsm.n_flights]}
    shown = calibration_metadata(samples, estimate_flights(samples, dsm), maintenance, dsm)
    return Shown((pl.DataFrame(model), design_parameters(dsm)), shown)
