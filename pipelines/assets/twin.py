"""Track each component's health, compare it with sensor and model, compute features of it and raise alerts."""

import json
from pathlib import Path

import polars as pl

from hdt_core.alerts.alerts import raise_alerts
from hdt_core.alerts.component_alerts import component_features, raise_component_alerts
from hdt_core.alerts.succession import lines_of_night
from hdt_core.calibration.dsm import Dsm
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.components.pack import CC, HX
from hdt_core.flight.admission import NominalBaseline, leg_indicators
from hdt_core.flight.control_schedules import ControlSchedules
from hdt_core.health.features import features as describe
from hdt_core.health.residuals import residuals as compare
from hdt_core.health.sensor_checks import cross_checks
from hdt_core.health.work import judge_log, known_log, settled_log
from hdt_core.margin.exchanger_demand import exchanger_demand
from hdt_core.record.usable import unused
from hdt_core.records.keys import FLIGHT
from hdt_core.tracking.loss_filter import TrackResult, join_tracks
from hdt_core.tracking.track import track
from pipelines.assets.calibration import CONTROLLERS, LEGS, laws_of
from pipelines.assets.components import conform_all, of_pack, parts_in_service, recorded_in, track_components
from pipelines.assets.raw import case_lines
from pipelines.assets.stage import stage
from pipelines.lineage import LINEAGE
from pipelines.resources import Home, PartitionScope
from pipelines.storage.cases import NIGHT, CaseLog
from pipelines.storage.settings import alert_limits


def model_of(calibration_dsm: pl.DataFrame) -> Dsm:
    """Read the Digital System Model in service."""
    return Dsm.from_dict(json.loads(calibration_dsm["model"][0]))


@stage
def twin_flights(legs_samples: pl.DataFrame, calibration_dsm: pl.DataFrame, home: Home) -> pl.DataFrame:
    """Estimate health of each pack from one flight alone by the parts' methods, for all flights of the run."""
    return estimate_flights(legs_samples, model_of(calibration_dsm), parts_in_service(home, "health"))


@stage
def twin_health(
    scope: PartitionScope,
    home: Home,
    twin_flights: pl.DataFrame,
    raw_maintenance: pl.DataFrame,
    calibration_dsm: pl.DataFrame,
    raw_components: pl.DataFrame,
    record_held: pl.DataFrame,
    legs_components: pl.DataFrame,
    calibration_components: pl.DataFrame,
    calibration_sisters: pl.DataFrame,
) -> tuple[pl.DataFrame, pl.DataFrame, pl.DataFrame]:
    """Track the Operational Digital Twin: each component's health after a flight, from that flight and all before it.

    It continues from the last checkpoint before the new flights; a checkpoint lists the flights it includes.
    """
    stored = TrackResult(*(scope.read_table(home.store, table) for table in ("twin_health", "twin_checkpoints")))
    rows = raw_components.join(unused(record_held), on=FLIGHT, how="anti", maintain_order="left")
    designs = (calibration_components, calibration_sisters)
    code = LINEAGE["twin_health"].code
    components, residuals = track_components(rows, legs_components, *designs, raw_maintenance, home, stored, code)
    tracks = [components]
    if twin_flights.height:
        parts = parts_in_service(home, "health")
        tracks.append(track(twin_flights, raw_maintenance, model_of(calibration_dsm), stored, code, parts))
    return *join_tracks(tracks), residuals


@stage
def residuals(legs_samples: pl.DataFrame, twin_flights: pl.DataFrame, calibration_dsm: pl.DataFrame) -> pl.DataFrame:
    """Compute sensor minus model, model minus twin and sensor minus twin, per flight and signal."""
    return compare(legs_samples, twin_flights, model_of(calibration_dsm))


@stage
def indicators(
    legs_samples: pl.DataFrame, legs_channels: pl.DataFrame, calibration_schedules: pl.DataFrame
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Compute indicators of each leg and cross checks of sensors, door and controllers against the fleet's laws."""
    norm = NominalBaseline.from_json(laws_of(calibration_schedules, LEGS))
    laws = ControlSchedules.from_dict(json.loads(laws_of(calibration_schedules, CONTROLLERS)))
    return leg_indicators(legs_samples, norm), cross_checks(legs_samples, laws, legs_channels)


@stage
def features_margin(
    legs_samples: pl.DataFrame, calibration_dsm: pl.DataFrame, calibration_schedules: pl.DataFrame
) -> pl.DataFrame:
    """Compute each flight's demand on the exchangers: the conductance below which the outlet leaves its set point."""
    laws = ControlSchedules.from_dict(json.loads(laws_of(calibration_schedules, CONTROLLERS)))
    return exchanger_demand(legs_samples, model_of(calibration_dsm), laws)


@stage
def features(
    twin_health: pl.DataFrame,
    residuals: pl.DataFrame,
    legs_verdicts: pl.DataFrame,
    raw_maintenance: pl.DataFrame,
    raw_messages: pl.DataFrame,
    twin_flights: pl.DataFrame,
    features_cross_checks: pl.DataFrame,
    features_margin: pl.DataFrame,
    residuals_components: pl.DataFrame,
    legs_components: pl.DataFrame,
) -> tuple[pl.DataFrame, pl.DataFrame, pl.DataFrame]:
    """Join health, residuals, trends, virtual sensors and cross checks of door and sensors, by flight and pack.

    The maintenance log is judged by the losses first.
    """
    declared = recorded_in(legs_components)
    judgements = judge_log(twin_health, raw_messages, raw_maintenance, (HX, CC, *declared))
    log_as_known = known_log(raw_maintenance, judgements)
    inputs = (twin_health, residuals_components, legs_components, log_as_known)
    pack = describe(
        of_pack(twin_health),
        residuals,
        legs_verdicts,
        log_as_known,
        twin_flights=twin_flights,
        cross_checks=features_cross_checks,
        demand=features_margin,
    )
    components = [component_features(*inputs, c) for c in declared]
    return pack, conform_all("features_components", components), judgements


@stage
def features_alerts(
    scope: PartitionScope,
    home: Home,
    features: pl.DataFrame,
    features_components: pl.DataFrame,
    features_work: pl.DataFrame,
    raw_maintenance: pl.DataFrame,
) -> pl.DataFrame:
    """Raise alerts: which loss grew, since when, what else could explain it, what to do.

    Where an alert of the night before is another one now, the log of cases gets a line: its case goes on with that.
    """
    limits = alert_limits(Path(home.home))
    work = settled_log(raw_maintenance, features_work)
    alerts = raise_alerts(features, work, limits)
    inputs = (features_components, work)
    others = (raise_component_alerts(*inputs, c, limits) for c in recorded_in(features_components))
    now = conform_all("features_alerts", [alerts, *others])
    before = scope.read_table(home.store, "features_alerts")
    departures = pl.concat([features["departed_at"], features_components["departed_at"]])
    log = CaseLog(Path(home.home))
    for line in lines_of_night(case_lines(scope, home), before, now, departures):
        log.append(line.alert, line.kind, NIGHT, line.body)
    return now
