"""Every stored table: grain, shards, key, columns with type, unit, span and meaning.

Checks, storage, the catalog's comments and the data dictionary are made from these declarations.
"""

from dataclasses import dataclass
from typing import Literal

import polars as pl

from hdt_core.tables import alerts, demand, features, prognosis, raw, twin
from hdt_core.tables.base import Table

_MONTH = pl.concat_str(pl.col("flight_id").str.slice(-11, 4), pl.lit("-"), pl.col("flight_id").str.slice(-7, 2))
_SHARDS = {"month": _MONTH, "flight": pl.col("flight_id"), "all": pl.lit("all")}


@dataclass(frozen=True, slots=True)
class StoredTable:
    """Declaration of a table's storage.

    Parameters
    ----------
    schema : Table
        Declaration of the columns.
    grain : str
        Partition the table is computed in: a flight of an aircraft, an aircraft, the fleet.
    shard : str
        One file of an aircraft holds a month, a flight or all.
    whole : bool
        Rows mean something only together: if one breaks the declaration, none is stored.
    key : tuple of str
        Columns the rows are sorted by; fixed so that the same rows make the same file.
    """

    schema: type[Table]
    grain: Literal["flight", "aircraft", "fleet"]
    key: tuple[str, ...]
    shard: Literal["month", "flight", "all"] = "all"
    whole: bool = False

    @property
    def shard_of(self) -> pl.Expr:
        """Expression that names the file a row belongs to."""
        return _SHARDS[self.shard].alias("shard")

    def conform(self, frame: pl.DataFrame) -> pl.DataFrame:
        """Return `frame` in the declared columns, order and types."""
        return self.schema.conform(frame)

    def repeated_keys(self, frame: pl.DataFrame) -> pl.DataFrame:
        """Return primary keys that occur more than once in `frame`, which is sorted by `key`."""
        unique = self.schema.primary_key()
        repeats = pl.all_horizontal(pl.col(c).eq_missing(pl.col(c).shift()) for c in self.key)
        # rows that share the sorting key are neighbours
        is_unique = set(self.key) <= set(unique) and not frame.select(repeats.any()).item()
        if not unique or is_unique:
            return frame.select(unique).clear()
        return frame.select(unique).filter(pl.struct(unique).is_duplicated()).unique()


_SAMPLE = ("flight_id", "pack", "time_utc")
_FLIGHT_PACK = ("flight_id", "pack")
_COMPONENT = ("component", *_FLIGHT_PACK)

TABLES: dict[str, StoredTable] = {
    "raw_snapshots": StoredTable(raw.RawSnapshots, "flight", _SAMPLE, "month"),
    "raw_logs": StoredTable(raw.RawLogs, "flight", _SAMPLE, "flight"),
    "raw_flights": StoredTable(raw.RawFlights, "flight", ("flight_id",), "month"),
    "raw_deliveries": StoredTable(raw.RawDeliveries, "flight", ("file", "flight_id"), "month", whole=True),
    "raw_quarantine": StoredTable(raw.RawQuarantine, "flight", ("file", "row", "column_name", "reason"), "month"),
    "record_held": StoredTable(raw.RecordHeld, "fleet", ("operator", "tail", "departed_at", "flight_id")),
    "raw_reports": StoredTable(raw.RawReports, "aircraft", ("reported_at", "report", "file")),
    "raw_messages": StoredTable(raw.RawMessages, "aircraft", ("message_time", "code", "flight_id", "pack")),
    "raw_maintenance": StoredTable(raw.RawMaintenance, "aircraft", ("done_on", "pack", "component", "reference")),
    "raw_maintenance_not_done": StoredTable(
        raw.RawMaintenanceNotDone, "aircraft", ("done_on", "pack", "component", "reference")
    ),
    "raw_checks": StoredTable(raw.RawChecks, "fleet", ("operator", "tail", "planned_on", "name")),
    "raw_costs": StoredTable(raw.RawCosts, "fleet", ("component", "item")),
    "raw_cases": StoredTable(raw.RawCases, "aircraft", ("line", "id")),
    "raw_records_deliveries": StoredTable(raw.RawDeliveries, "aircraft", ("file",), whole=True),
    "raw_records_quarantine": StoredTable(raw.RawQuarantine, "aircraft", ("file", "row", "column_name", "reason")),
    "raw_fleet": StoredTable(raw.RawFleet, "fleet", ("operator", "tail", "valid_from", "msn")),
    "raw_coverage": StoredTable(raw.RawCoverage, "fleet", ("operator", "tail", "component", "parameter")),
    "raw_files_deliveries": StoredTable(raw.RawDeliveries, "fleet", ("file",), whole=True),
    "raw_files_quarantine": StoredTable(raw.RawQuarantine, "fleet", ("file", "row", "column_name", "reason")),
    "legs_samples": StoredTable(raw.LegsSamples, "flight", _SAMPLE, "month"),
    "legs_verdicts": StoredTable(raw.LegsVerdicts, "flight", _FLIGHT_PACK, "month"),
    "legs_channels": StoredTable(raw.LegsChannels, "flight", (*_FLIGHT_PACK, "source", "signal"), "month"),
    "legs_indicators": StoredTable(raw.LegsIndicators, "flight", _FLIGHT_PACK, "month"),
    "legs_admitted": StoredTable(raw.LegsAdmitted, "aircraft", _FLIGHT_PACK),
    "calibration_dsm": StoredTable(twin.CalibrationDsm, "fleet", ("dsm_version",), whole=True),
    "calibration_design": StoredTable(
        twin.CalibrationDesign,
        "fleet",
        ("scope", "operator", "tail", "pack", "component", "parameter"),
        whole=True,
    ),
    "calibration_schedules": StoredTable(twin.CalibrationSchedules, "fleet", ("name",), whole=True),
    "calibration_window": StoredTable(twin.CalibrationWindow, "fleet", ("operator", "tail")),
    "twin_flights": StoredTable(twin.TwinFlights, "flight", _FLIGHT_PACK, "month"),
    "twin_health": StoredTable(twin.TwinHealth, "aircraft", ("departed_at", "flight_id", "pack", "parameter")),
    "twin_checkpoints": StoredTable(
        twin.TwinCheckpoints, "aircraft", ("pack", "component", "parameter", "chapter", "history"), whole=True
    ),
    "residuals": StoredTable(twin.Residuals, "flight", ("flight_id", "pack", "signal", "kind"), "month"),
    "features_cross_checks": StoredTable(features.FeaturesCrossChecks, "flight", _FLIGHT_PACK, "month"),
    "features_margin": StoredTable(demand.FeaturesMargin, "flight", _FLIGHT_PACK, "month"),
    "features": StoredTable(features.Features, "aircraft", ("departed_at", "flight_id", "pack")),
    "features_work": StoredTable(raw.FeaturesWork, "aircraft", ("done_on", "pack", "component", "reference")),
    "features_alerts": StoredTable(alerts.FeaturesAlerts, "aircraft", ("raised_at", "alert_id")),
    "prognosis_base": StoredTable(prognosis.PrognosisBase, "fleet", ("model_version",), whole=True),
    "prognosis_model": StoredTable(prognosis.PrognosisModel, "fleet", ("month",), whole=True),
    "prognoses": StoredTable(prognosis.Prognoses, "fleet", ("operator", "tail", "flight_id", "pack", "component")),
    "prognosis_lives": StoredTable(
        prognosis.PrognosisLives, "fleet", ("operator", "tail", "pack", "component", "life")
    ),
    "prognosis_choices": StoredTable(
        prognosis.PrognosisChoices, "fleet", ("operator", "tail", "pack", "component", "choice")
    ),
    "components": StoredTable(twin.ComponentList, "fleet", ("component",)),
    "raw_components": StoredTable(twin.RawComponents, "aircraft", ("component", *_SAMPLE, "signal")),
    "raw_components_deliveries": StoredTable(raw.RawDeliveries, "aircraft", ("file",), whole=True),
    "raw_components_quarantine": StoredTable(raw.RawQuarantine, "aircraft", ("file", "row", "column_name", "reason")),
    "legs_components": StoredTable(twin.LegsComponents, "aircraft", _COMPONENT),
    "calibration_components": StoredTable(
        twin.CalibrationComponents, "aircraft", ("tail", "pack", "component", "parameter")
    ),
    "calibration_sisters": StoredTable(twin.CalibrationSisters, "fleet", ("operator", "tail", "pack", "component")),
    "residuals_components": StoredTable(twin.ResidualsComponents, "aircraft", (*_COMPONENT, "signal", "kind")),
    "features_components": StoredTable(twin.FeaturesComponents, "aircraft", _COMPONENT),
}
