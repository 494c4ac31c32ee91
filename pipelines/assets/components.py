"""Process the declared components' own files: to legs, design, and health for the twin of all components."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import polars as pl

from hdt_core.calibration import baseline_wear
from hdt_core.components import Component, component_rows, recorded_components
from hdt_core.components.pack import CC, HX, PARTS, Parts
from hdt_core.flight.component_legs import component_samples
from hdt_core.health.residuals import component_residuals
from hdt_core.record.usable import unused
from hdt_core.records.keys import AIRCRAFT, FLIGHT, LEG
from hdt_core.tables import TABLES
from hdt_core.tracking import track
from hdt_core.tracking.component_readings import component_readings
from hdt_core.tracking.loss_filter import TrackResult, join_tracks
from pipelines.assets.raw import account, with_aircraft
from pipelines.assets.stage import StageResult, stage
from pipelines.intake.airframes import with_airframe
from pipelines.intake.components import read_components
from pipelines.intake.faults import NO_FAULTS
from pipelines.intake.ingest import landing_files, register_unread
from pipelines.lineage import STAGE
from pipelines.resources import Home, PartitionScope
from pipelines.storage.settings import Use, accepted_terms, by_home

SAMPLE = [*LEG, "component", "time_utc", "signal"]


@stage
def declared_components() -> pl.DataFrame:
    """List the pack's components and those that packages declare."""
    prior_sds = {HX.code: baseline_wear.entry_sd(baseline_wear.ENTRY), CC.code: baseline_wear.entry_sd(track.ENTRY)}
    rows = [row | {"prior_sd": prior_sds.get(str(row["component"]))} for row in component_rows()]
    return pl.DataFrame(rows, infer_schema_length=None)


def of_pack(rows: pl.DataFrame) -> pl.DataFrame:
    """Select the rows of the pack's own components."""
    return rows.filter(pl.col("component").is_in((HX.code, CC.code)))


def recorded_in(rows: pl.DataFrame) -> list[Component]:
    """List the declared components that some of the rows are of; the others need not be gone through."""
    codes = set(rows["component"].unique())
    return [c for c in recorded_components().values() if c.code in codes]


def in_service(rows: pl.DataFrame, home: Home, use: Use) -> list[Component]:
    """List the components of `recorded_in` with the physical terms that an engineer has accepted.

    And with the method that the home names for this `use`.
    """
    folder = Path(home.home)
    return [by_home(c.with_terms(accepted_terms(folder)), folder, use) for c in recorded_in(rows)]


def parts_in_service(home: Home, use: Use) -> Parts:
    """Return the pack's parts with the methods that the home names for this `use`."""
    return Parts(*(by_home(part, Path(home.home), use) for part in PARTS))


@stage
def raw_components(scope: PartitionScope, home: Home) -> StageResult:
    """Ingest the components' own files; rows stay of files that left the landing zone or hold no good row now."""
    listing = home.ledger.of(scope.aircraft or {}).files(["component", "recorder"])
    present_files = landing_files(Path(home.landing), listing)
    files = [f for f in present_files if f.is_recording or f.folder in recorded_components()]
    is_own = pl.col("file").is_in(listing["path"].to_list())
    stored = (scope.read_table(home.store, table) for table in STAGE["raw_components"].tables)
    rows, accounts, quarantine = (frame.filter(is_own) for frame in stored)
    packs = dict(rows.group_by("file").agg(pl.col("pack").max()).iter_rows())
    intakes = read_components([replace(f, packs_stored=packs.get(f.path, 0)) for f in files], datetime.now(UTC))
    read_quarantine = pl.concat([NO_FAULTS, *(d.quarantine for _, d in intakes)])
    inputs_changed = register_unread(home.ledger, listing, present_files, read_quarantine)
    present = [f.path for f in files]
    with_rows = [f.path for f, d in intakes if d.n_good]
    empty = [path for path in present if path in packs and path not in with_rows]
    is_empty, is_replaced = (pl.col("file").is_in(paths) for paths in (empty, [p for p in present if p not in empty]))
    accounts = accounts.filter(~is_replaced).with_columns(
        delivered=pl.when(is_empty).then(pl.col("loaded") + pl.col("duplicate")).otherwise("delivered"),
        quarantined=pl.when(is_empty).then(0).otherwise("quarantined"),
    )
    new_rows = (with_airframe(d.rows, f) for f, d in intakes)
    rows = pl.concat([rows.filter(~is_replaced), *new_rows], how="diagonal_relaxed")
    accounts = pl.concat([accounts, *(with_aircraft(f, account(f, d)) for f, d in intakes)], how="diagonal_relaxed")
    quarantines = [with_aircraft(f, d.quarantine) for f, d in intakes]
    frames = (
        rows.unique(SAMPLE, keep="last", maintain_order=True),
        accounts.group_by("operator", "tail", "file").agg(
            pl.col("delivered", "loaded", "quarantined", "duplicate").sum()
        ),
        pl.concat([quarantine.filter(~pl.col("file").is_in(present)), *quarantines], how="diagonal_relaxed"),
    )
    of_run = scope.cells().select(AIRCRAFT)  # a file may hold rows of another airframe, too
    own_frames = tuple(frame.join(of_run, on=AIRCRAFT, how="semi", maintain_order="left") for frame in frames)
    return StageResult(own_frames, {}, inputs_changed)


@stage
def calibration_components(
    raw_components: pl.DataFrame,
    record_held: pl.DataFrame,
    raw_maintenance: pl.DataFrame,
    raw_reports: pl.DataFrame,
    home: Home,
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Select steady flights of each component and estimate the design of each pack's first unit."""
    from hdt_core.tracking.component_units import commission  # its estimators take half a second to load

    rows = raw_components.join(unused(record_held), on=FLIGHT, how="anti", maintain_order="left")
    results = [commission(rows, raw_maintenance, c, raw_reports) for c in in_service(rows, home, "design")]
    legs = conform_all("legs_components", [x for x, _ in results])
    design = conform_all("calibration_components", [d for _, d in results])
    return legs, design.with_columns(pl.lit("tail").alias("scope"))


@stage
def calibration_sisters(calibration_components: pl.DataFrame) -> pl.DataFrame:
    """Pool the designs of sister units: the clean level and spread that each pack's sisters let expect."""
    levels = []
    for component in recorded_in(calibration_components):
        from hdt_core.tracking.sisters import clean_levels

        levels.append(clean_levels(calibration_components, component))
    return conform_all("calibration_sisters", levels)


def track_components(
    signals: pl.DataFrame, legs: pl.DataFrame, design: pl.DataFrame, sisters: pl.DataFrame, maintenance: pl.DataFrame,
    home: Home, stored: TrackResult, code: str,
) -> tuple[TrackResult, pl.DataFrame]:  # fmt: skip
    """Track each declared component's health after each flight; also residuals of its sensors, model and twin.

    Parameters
    ----------
    signals, legs, design, sisters, maintenance : DataFrame
        Tables `raw_components`, `legs_components`, `calibration_components`, `calibration_sisters`, `raw_maintenance`.
    home : Home
    stored : TrackResult
        Of the last night.
    code : str
        Version of the code; results under another are not used.
    """
    tracks = []
    readings = []
    residuals = []
    for component in in_service(signals, home, "health"):
        from hdt_core.tracking.component_units import unit_health  # loaded only where a component has a record

        samples = component_samples(signals, component)
        inputs = (samples, legs.filter(component=component.code), design, maintenance, component)
        flights, tracked = unit_health(*inputs, stored, f"{code}|{component.version}", sisters)
        tracks.append(tracked)
        readings.append(component_readings(samples, component))
        residuals += _residuals(samples, flights, design, component)
    tracked = join_tracks(tracks)
    health = pl.concat([tracked.health, *readings])
    return tracked._replace(health=health), conform_all("residuals_components", residuals)


def _residuals(
    samples: pl.DataFrame, flights: pl.DataFrame, design: pl.DataFrame, component: Component
) -> list[pl.DataFrame]:
    """Compute residuals of each pack against its own model."""
    from hdt_core.tracking.component_units import pack_models

    nominal = samples.filter("nominal").join(flights, on=LEG, how="semi")
    return [
        component_residuals(pack_samples, flights, model, component.code)
        for model, _, pack_samples in pack_models(nominal, design, component)
        if pack_samples.height
    ]


def conform_all(table: str, frames: list[pl.DataFrame]) -> pl.DataFrame:
    """Concatenate frames of all components in a table's declared columns."""
    schema = TABLES[table].schema
    return pl.concat([schema.create_empty(), *(schema.conform(f) for f in frames)])
