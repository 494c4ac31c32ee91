"""Every stored table: grain, shards, key, columns with type, unit, span and meaning.

Checks, storage, the catalog's comments and the data dictionary are made from these declarations.
"""

from dataclasses import dataclass
from typing import Literal

import polars as pl

from hdt_core.tables import calibration, components, features, legs, prognosis, raw, residuals, twin
from hdt_core.tables.base import Table

_MONTH = pl.concat_str(pl.col("flight_id").str.slice(-11, 4), pl.lit("-"), pl.col("flight_id").str.slice(-7, 2))
_SHARDS = {"month": _MONTH, "flight": pl.col("flight_id"), "all": pl.lit("all")}


@dataclass(frozen=True, slots=True)
class Entry:
    """How a table is kept.

    Parameters
    ----------
    schema : Table
        Declaration of the columns.
    grain : str
        Partition the table is computed in: a flight of an aircraft, an aircraft, the fleet.
    shard : str
        One file of an aircraft holds a month, a flight or all.
    open : bool
        Columns beyond the declared ones are kept.
    whole : bool
        Rows mean something only together: if one breaks the declaration, none is stored.
    key : tuple of str
        Columns the rows are sorted by; fixed so that the same rows make the same file.
    """

    schema: type[Table]
    grain: Literal["flight", "aircraft", "fleet"]
    key: tuple[str, ...]
    shard: Literal["month", "flight", "all"] = "all"
    open: bool = False
    whole: bool = False

    @property
    def shard_of(self) -> pl.Expr:
        """Expression that names the file a row belongs to."""
        return _SHARDS[self.shard].alias("shard")

    def conform(self, frame: pl.DataFrame) -> pl.DataFrame:
        """`frame` in the declared columns, order and types."""
        declared = self.schema.conform(frame)
        return declared.hstack(frame.drop(declared.columns, strict=False)) if self.open else declared


_SAMPLE = ("flight_id", "pack", "time_utc")
_FLIGHT_PACK = ("flight_id", "pack")
_COMPONENT = ("component", *_FLIGHT_PACK)

TABLES: dict[str, Entry] = {
    "raw_snapshots": Entry(raw.RawSnapshots, "flight", _SAMPLE, "month"),
    "raw_logs": Entry(raw.RawLogs, "flight", _SAMPLE, "flight"),
    "raw_flights": Entry(raw.RawFlights, "flight", ("flight_id",), "month"),
    "raw_deliveries": Entry(raw.RawDeliveries, "flight", ("file", "flight_id"), "month", whole=True),
    "raw_quarantine": Entry(raw.RawQuarantine, "flight", ("file", "row", "column_name", "reason"), "month"),
    "raw_reports": Entry(raw.RawReports, "aircraft", ("reported_at", "report", "file")),
    "raw_messages": Entry(raw.RawMessages, "aircraft", ("message_time", "code", "flight_id", "pack")),
    "raw_maintenance": Entry(raw.RawMaintenance, "aircraft", ("done_on", "pack", "component", "reference")),
    "raw_checks": Entry(raw.RawChecks, "fleet", ("operator", "tail", "planned_on", "name")),
    "raw_costs": Entry(raw.RawCosts, "fleet", ("component", "item")),
    "raw_cases": Entry(raw.RawCases, "aircraft", ("line",)),
    "raw_records_deliveries": Entry(raw.RawDeliveries, "aircraft", ("file",), whole=True),
    "raw_records_quarantine": Entry(raw.RawQuarantine, "aircraft", ("file", "row", "column_name", "reason")),
    "raw_fleet": Entry(raw.RawFleet, "fleet", ("operator", "tail")),
    "raw_coverage": Entry(raw.RawCoverage, "fleet", ("operator", "tail", "component", "parameter")),
    "raw_files_deliveries": Entry(raw.RawDeliveries, "fleet", ("file",), whole=True),
    "raw_files_quarantine": Entry(raw.RawQuarantine, "fleet", ("file", "row", "column_name", "reason")),
    "legs_samples": Entry(legs.LegsSamples, "flight", _SAMPLE, "month"),
    "legs_verdicts": Entry(legs.LegsVerdicts, "flight", _FLIGHT_PACK, "month"),
    "legs_signs": Entry(legs.LegsSigns, "flight", _FLIGHT_PACK, "month"),
    "legs_admitted": Entry(legs.LegsAdmitted, "aircraft", _FLIGHT_PACK),
    "calibration_dsm": Entry(calibration.CalibrationDsm, "fleet", ("dsm_version",), whole=True),
    "calibration_design": Entry(
        calibration.CalibrationDesign,
        "fleet",
        ("scope", "operator", "tail", "pack", "component", "parameter"),
        whole=True,
    ),
    "calibration_laws": Entry(calibration.CalibrationLaws, "fleet", ("name",), whole=True),
    "calibration_window": Entry(calibration.CalibrationWindow, "fleet", ("operator", "tail")),
    "twin_flights": Entry(twin.TwinFlights, "flight", _FLIGHT_PACK, "month", open=True),
    "twin_health": Entry(twin.TwinHealth, "aircraft", ("departed_at", "flight_id", "pack", "parameter")),
    "twin_chapters": Entry(twin.TwinChapters, "aircraft", ("pack", "chapter", "history"), whole=True),
    "residuals": Entry(residuals.Residuals, "flight", ("flight_id", "pack", "signal", "kind"), "month"),
    "features_witnesses": Entry(features.FeaturesWitnesses, "flight", _FLIGHT_PACK, "month"),
    "features_margin": Entry(features.FeaturesMargin, "flight", _FLIGHT_PACK, "month"),
    "features": Entry(features.Features, "aircraft", ("departed_at", "flight_id", "pack"), open=True),
    "features_alerts": Entry(features.FeaturesAlerts, "aircraft", ("raised_at", "alert_id")),
    "prognosis_base": Entry(prognosis.PrognosisModel, "fleet", ("model_version",), whole=True),
    "prognosis_model": Entry(prognosis.PrognosisModel, "fleet", ("model_version",), whole=True),
    "prognoses": Entry(prognosis.Prognoses, "fleet", ("operator", "tail", "flight_id", "pack", "component")),
    "prognosis_lives": Entry(prognosis.PrognosisLives, "fleet", ("operator", "tail", "pack", "component", "life")),
    "components": Entry(components.ComponentsDeclared, "fleet", ("component",)),
    "raw_components": Entry(components.RawComponents, "aircraft", ("component", *_SAMPLE, "signal")),
    "raw_components_deliveries": Entry(raw.RawDeliveries, "aircraft", ("file",), whole=True),
    "raw_components_quarantine": Entry(raw.RawQuarantine, "aircraft", ("file", "row", "column_name", "reason")),
    "legs_components": Entry(components.LegsComponents, "aircraft", _COMPONENT),
    "calibration_components": Entry(
        components.CalibrationComponents, "aircraft", ("tail", "pack", "component", "parameter")
    ),
    "twin_components": Entry(components.TwinComponents, "aircraft", (*_COMPONENT, "parameter")),
    "residuals_components": Entry(components.ResidualsComponents, "aircraft", (*_COMPONENT, "signal", "kind")),
    "features_components": Entry(components.FeaturesComponents, "aircraft", _COMPONENT),
    "features_component_alerts": Entry(components.FeaturesComponentAlerts, "aircraft", ("raised_at", "alert_id")),
    "prognoses_components": Entry(components.PrognosesComponents, "fleet", ("operator", "tail", *_COMPONENT)),
    "prognoses_components_lives": Entry(
        components.PrognosesComponentsLives, "fleet", ("operator", "tail", "pack", "component", "life")
    ),
}
