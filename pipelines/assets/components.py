"""Declared components along the same chain: from files of their own to legs, twin, alerts and remaining life."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import polars as pl

from hdt_core.alerts.component_alerts import component_features, raise_component_alerts
from hdt_core.components import Component, component_rows, recorded_components
from hdt_core.flight.component_legs import LEG, component_samples
from hdt_core.health.residuals import component_residuals
from hdt_core.prognosis.component_life import component_prognoses
from hdt_core.prognosis.unit_lives import Failure, component_lives, told_lives
from hdt_core.records.keys import PACK
from hdt_core.tables import TABLES
from hdt_core.tracking.component_readings import component_readings
from pipelines.assets.raw import account, left, of_aircraft
from pipelines.assets.stage import stage
from pipelines.intake.components import read_components
from pipelines.intake.ingest import landing_files
from pipelines.partitions import PartitionScope
from pipelines.resources import Home
from pipelines.storage.settings import accepted_terms

SAMPLE = [*LEG, "component", "time_utc", "signal"]


@stage
def declared_components() -> pl.DataFrame:
    """The components that the chain knows: those of the pack, and those that packages declare."""
    return pl.DataFrame(component_rows())


def in_service(home: Home) -> list[Component]:
    """Components that files describe, each with the physical terms that an engineer has accepted."""
    return [c.with_terms(accepted_terms(Path(home.home))) for c in recorded_components().values()]


@stage
def raw_components(scope: PartitionScope, home: Home) -> tuple[pl.DataFrame, ...]:
    """What the components' own files recorded; of files that have left the landing zone what is stored stays."""
    listed = home.ledger.of(scope.aircraft or {}).files(["component", "recorder"])
    wanted = pl.struct("operator", "tail").is_in([{"operator": o, "tail": t} for o, t in scope.aircraft or {}])
    files = landing_files(Path(home.landing), listed.filter(wanted))
    files = [f for f in files if f.is_recording or f.folder in recorded_components()]
    stored = scope.read_table(home.store, "raw_components")
    packs = dict(stored.group_by("file").agg(pl.col("pack").max()).iter_rows())
    files = [replace(f, packs_stored=packs.get(f.path, 0)) for f in files]
    read = read_components(files, datetime.now(UTC))
    present, good = [f.path for f in files], [f.path for f, d in read if d.n_good]
    old = left("raw_components_deliveries", present, scope, home.store)
    silent = [path for path in present if path in packs and path not in good]  # they take nothing away
    before = scope.read_table(home.store, "raw_components_deliveries").filter(pl.col("file").is_in(silent))
    before = before.with_columns(delivered=pl.col("loaded") + pl.col("duplicate"), quarantined=pl.lit(0, pl.Int64))
    accounts = pl.concat([before, *(of_aircraft(f, account(f, d)) for f, d in read)], how="diagonal_relaxed")
    gone = [path for path in present if path not in silent]
    kept = left("raw_components", gone, scope, home.store)
    rows = pl.concat([kept, *(d.rows for _, d in read)], how="diagonal_relaxed")
    aside = left("raw_components_quarantine", present, scope, home.store)
    return (
        rows.unique(SAMPLE, keep="last", maintain_order=True),
        pl.concat([old, _summed(accounts)], how="diagonal_relaxed"),
        pl.concat([aside, *(of_aircraft(f, d.quarantine) for f, d in read)], how="diagonal_relaxed"),
    )


def _summed(accounts: pl.DataFrame) -> pl.DataFrame:
    """One account a file."""
    counts = pl.col("delivered", "loaded", "quarantined", "duplicate")
    return accounts.group_by("operator", "tail", "file").agg(counts.sum())


@stage
def calibration_components(
    raw_components: pl.DataFrame, raw_maintenance: pl.DataFrame, raw_reports: pl.DataFrame, home: Home
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Which flights of a component are steady, and how each pack's first unit was built."""
    from hdt_core.tracking.component_units import commission  # its estimators take half a second to load

    told = [commission(raw_components, raw_maintenance, c, raw_reports) for c in in_service(home)]
    legs, design = _all("legs_components", [x for x, _ in told]), _all("calibration_components", [d for _, d in told])
    return legs, design.with_columns(pl.lit("tail").alias("scope"))


@stage
def twin_components(
    raw_components: pl.DataFrame,
    legs_components: pl.DataFrame,
    calibration_components: pl.DataFrame,
    raw_maintenance: pl.DataFrame,
    home: Home,
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Health of each component after each flight, and how far sensor, model and twin are apart."""
    from hdt_core.tracking.component_units import unit_health

    health, residuals = [], []
    for component in in_service(home):
        legs = legs_components.filter(component=component.code)
        samples = component_samples(raw_components, component)
        flights, tracked = unit_health(samples, legs, calibration_components, raw_maintenance, component)
        health += [tracked, component_readings(samples, component)]
        residuals += _residuals(samples, flights, calibration_components, component)
    return _all("twin_components", health), _all("residuals_components", residuals)


def _residuals(
    samples: pl.DataFrame, flights: pl.DataFrame, design: pl.DataFrame, component: Component
) -> list[pl.DataFrame]:
    """Of each pack against its own model."""
    from hdt_core.tracking.component_units import calibrated_model

    known = samples.filter("nominal").join(flights, on=LEG, how="semi")
    packs = design.filter(component=component.code).group_by(PACK, maintain_order=True)
    return [
        component_residuals(own, flights, calibrated_model(rows, component), component.code)
        for key, rows in packs
        if (own := known.filter(*(pl.col(c) == v for c, v in zip(PACK, key, strict=True)))).height
    ]


@stage
def features_components(
    twin_components: pl.DataFrame,
    residuals_components: pl.DataFrame,
    legs_components: pl.DataFrame,
    raw_maintenance: pl.DataFrame,
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """What the loss of each component shows, and the cases that want a person."""
    declared = recorded_components().values()
    known = (twin_components, residuals_components, legs_components, raw_maintenance)
    described = _all("features_components", [component_features(*known, c) for c in declared])
    alerts = [raise_component_alerts(described, raw_maintenance, c) for c in declared]
    return described, _all("features_component_alerts", alerts)


@stage
def prognoses_components(
    features_components: pl.DataFrame, raw_messages: pl.DataFrame, raw_maintenance: pl.DataFrame
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """How long each component has left: its trend until the loss at which others failed, or that it declares."""
    known = (features_components, raw_messages, raw_maintenance)
    declared = recorded_components().values()
    outlook = _all("prognoses_components", [component_prognoses(*known, c) for c in declared])
    return outlook, _all("prognoses_components_lives", [_lives(*known, c) for c in declared])


def _lives(
    described: pl.DataFrame, messages: pl.DataFrame, maintenance: pl.DataFrame, component: Component
) -> pl.DataFrame:
    """Lives of a component's units; without a message of its own none of them is seen to fail."""
    rows = described.filter(component=component.code)
    failure = Failure(component.code, component.message_code or "")
    return told_lives(rows, component_lives(rows, messages, maintenance, failure))


def _all(table: str, frames: list[pl.DataFrame]) -> pl.DataFrame:
    """Frames of all components in the declared columns of a table."""
    schema = TABLES[table].schema
    return pl.concat([schema.create_empty(), *(schema.conform(f) for f in frames)])
