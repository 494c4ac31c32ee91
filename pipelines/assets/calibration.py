"""How the aircraft were built: the Digital System Model, from the commissioning window of each tail."""

import json
from pathlib import Path

import polars as pl

from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.design_table import design_parameters
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.flight.admission import admit_by, learn_baseline
from hdt_core.flight.bleed import turn_away_odd_bleed
from hdt_core.flight.nominal_baseline import leg_indicators
from hdt_core.flight.phases import LEG_KEY
from hdt_core.margin.control_schedules import learn_schedules
from pipelines.assets.stage import StageResult, stage
from pipelines.baseline import baseline_cells, baseline_records
from pipelines.report.plots import calibration_metadata
from pipelines.resources import Home
from pipelines.storage.settings import accepted_terms


@stage
def calibration(home: Home) -> StageResult:
    """Design parameters and nominal health of fleet, operator and tail, estimated together from nominal legs."""
    store, cells = home.store, baseline_cells(home.ledger)
    within = pl.col("flight_id").is_in(cells["flight_id"].implode())
    # in one order, whoever wrote the rows when: sums round by it, and the laws would differ from machine to machine
    samples = store.scan("legs_samples").filter(within).collect().sort(*LEG_KEY, "time_utc", "source")
    verdicts = store.scan("legs_verdicts").filter(within).collect().sort(LEG_KEY)
    maintenance, messages, reports = (
        baseline_records(store, t, cells) for t in ("raw_maintenance", "raw_messages", "raw_reports")
    )
    verdicts = turn_away_odd_bleed(verdicts, reports)
    norm = learn_baseline(verdicts, samples, maintenance, messages)
    admitted = admit_by(norm, verdicts, leg_indicators(samples, norm), maintenance, messages)
    dsm = calibrate(samples, admitted, maintenance, accepted_terms(Path(home.home)))
    model = {"dsm_version": [dsm.dsm_version], "model": [json.dumps(dsm.to_dict())], "n_flights": [dsm.n_flights]}
    shown = calibration_metadata(samples, estimate_flights(samples, dsm), maintenance, dsm)
    laws = {LEGS: norm.to_json(), CONTROLLERS: json.dumps(learn_schedules(samples).to_dict())}
    held = pl.DataFrame({"name": list(laws), "laws": list(laws.values())})
    return StageResult((pl.DataFrame(model), design_parameters(dsm), held, window(verdicts)), shown)


def window(verdicts: pl.DataFrame) -> pl.DataFrame:
    """From when until when each aircraft's flights were used: operator, tail, n_flights, from_at, until_at."""
    at = pl.col("departed_at")
    span = (pl.col("flight_id").n_unique().cast(pl.Int64).alias("n_flights"), at.min().alias("from_at"))
    return verdicts.group_by("operator", "tail").agg(*span, at.max().alias("until_at"))


LEGS, CONTROLLERS = "legs", "controllers"


def laws_of(calibration_laws: pl.DataFrame, name: str) -> str:
    """One set of laws in service, as JSON."""
    return str(calibration_laws.filter(name=name)["laws"].item())
