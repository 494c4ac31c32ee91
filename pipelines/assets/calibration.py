"""Classify legs as nominal, and calibrate the Digital System Model from the commissioning window of each tail."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import dagster as dg
import polars as pl

from hdt_core.calibration.baseline_wear import audit_drift
from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.dsm import Dsm, design_parameters
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.flight.admission import NominalBaseline, admit, learn_baseline, leg_indicators
from hdt_core.flight.channels import find_channels
from hdt_core.flight.control_schedules import learn_schedules
from hdt_core.flight.legs import judge_legs, reject_odd_bleed
from hdt_core.record.usable import usable_rows
from hdt_core.records.keys import FLIGHT_PACK, LEG, of_each_aircraft
from hdt_core.tables.raw import SIGNALS
from pipelines.assets.components import parts_in_service
from pipelines.assets.stage import StageResult, stage
from pipelines.report.plots import as_png, figure_12, figure_13, figure_15, outlet_residuals
from pipelines.resources import Home
from pipelines.storage.settings import accepted_terms
from pipelines.storage.store import Store
from pipelines.versions import baseline_cells, baseline_records


@stage
def legs(raw_snapshots: pl.DataFrame, raw_logs: pl.DataFrame, record_held: pl.DataFrame) -> tuple[pl.DataFrame, ...]:
    """Classify each leg that is used by its own record alone: channels, phase, completeness, steady state."""
    rows = usable_rows(pl.concat([raw_snapshots, raw_logs]), record_held)
    channels = find_channels(rows)
    verdicts, samples = judge_legs(rows, channels)
    return samples, verdicts, channels


@stage
def legs_admitted(
    legs_verdicts: pl.DataFrame,
    legs_indicators: pl.DataFrame,
    raw_maintenance: pl.DataFrame,
    raw_reports: pl.DataFrame,
    raw_messages: pl.DataFrame,
    twin_health: pl.DataFrame,
    twin_flights: pl.DataFrame,
    calibration_schedules: pl.DataFrame,
) -> pl.DataFrame:
    """Admit legs by logs, printed reports, cross checks and the twin, with hindsight."""
    baseline = NominalBaseline.from_json(laws_of(calibration_schedules, LEGS))
    verdicts = reject_odd_bleed(legs_verdicts, raw_reports)
    return admit(baseline, verdicts, legs_indicators, raw_maintenance, raw_messages, twin_health, twin_flights)


@stage
def calibration(home: Home) -> StageResult:
    """Estimate design parameters and nominal health of fleet, operator and tail from nominal legs."""
    store = home.store
    cells = baseline_cells(home.ledger)
    samples = _of_cells(store, "legs_samples", cells, SAMPLE_COLUMNS, (*LEG, "time_utc", "source"))
    verdicts = _of_cells(store, "legs_verdicts", cells, ("*",), LEG)
    maintenance, messages, reports = (
        baseline_records(store, t, cells) for t in ("raw_maintenance", "raw_messages", "raw_reports")
    )
    verdicts = reject_odd_bleed(verdicts, reports)
    baseline = learn_baseline(verdicts, samples, maintenance, messages)
    admitted = admit(baseline, verdicts, leg_indicators(samples, baseline), maintenance, messages)
    parts = parts_in_service(home, "design")
    dsm = calibrate(samples, admitted, maintenance, accepted_terms(Path(home.home)), parts)
    text = json.dumps(dsm.to_dict())
    status = dsm.exchanger_status
    model = {"dsm_version": dsm.dsm_version, "model": text, "n_flights": dsm.n_flights, "status": status}
    estimates = of_each_aircraft(samples, lambda pack_samples: estimate_flights(pack_samples, dsm))
    plots = calibration_metadata(samples, estimates, maintenance, dsm)
    laws = {LEGS: baseline.to_json(), CONTROLLERS: json.dumps(learn_schedules(samples).to_dict())}
    schedules = pl.DataFrame({"name": list(laws), "laws": list(laws.values())})
    return StageResult((pl.DataFrame([model]), design_parameters(dsm), schedules, window(verdicts)), plots)


SAMPLE_COLUMNS = (*LEG, "time_utc", "source", "departed_at", "phase", "monitored", "n_averaged", *SIGNALS)
"""Columns of the samples that calibration needs; more would take memory on a large fleet."""


def _of_cells(
    store: Store, table: str, cells: pl.DataFrame, columns: Sequence[str], order: Sequence[str]
) -> pl.DataFrame:
    """Read rows of these cells aircraft by aircraft; the whole fleet's at once take four times the memory.

    They are sorted, for sums round by the order of rows, and the laws would differ from machine to machine.
    """
    parts = [store.read_table(table, []).select(columns)]
    for (operator, tail), flights in cells.sort("operator", "tail").group_by("operator", "tail", maintain_order=True):
        rows = store.scan(table, [(str(operator), str(tail))], flights["flight_id"]).select(columns)
        parts.append(rows.filter(pl.col("flight_id").is_in(flights["flight_id"].implode())).collect().sort(order))
    return pl.concat(parts, rechunk=True)


def window(verdicts: pl.DataFrame) -> pl.DataFrame:
    """Return the time span of each aircraft's flights: operator, tail, n_flights, from_at, until_at."""
    at = pl.col("departed_at")
    span = (pl.col("flight_id").n_unique().cast(pl.Int64).alias("n_flights"), at.min().alias("from_at"))
    return verdicts.group_by("operator", "tail").agg(*span, at.max().alias("until_at"))


LEGS, CONTROLLERS = "legs", "controllers"


def laws_of(calibration_schedules: pl.DataFrame, name: str) -> str:
    """Return one set of laws in service, as JSON."""
    return str(calibration_schedules.filter(name=name)["laws"].item())


def calibration_metadata(
    samples: pl.DataFrame, twin_flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm
) -> dict[str, Any]:
    """Return figures, the comparison of equation (6)'s forms and the drift audit as Dagster's metadata.

    Parameters
    ----------
    samples, twin_flights : DataFrame
        Of the baseline: samples of the leg filter, and their estimates by `estimate_flights`.
    """
    audit = audit_drift(twin_flights, maintenance, dsm)
    cruise = _longest_cruise(samples)
    own = twin_flights.join(cruise.select(FLIGHT_PACK).head(1), on=FLIGHT_PACK, validate="m:1")
    figures = {
        "figure_12": figure_12(twin_flights, dsm.compressor),
        "figure_13": figure_13(twin_flights, dsm.compressor),
        "figure_15": figure_15(outlet_residuals(cruise, own, dsm)),
    }
    images = {name: dg.MetadataValue.md(f"![figure]({as_png(figure)})") for name, figure in figures.items()}
    return images | {
        "equation_6": dg.MetadataValue.md(_table(pl.DataFrame(dsm.compressor.forms))),
        "drift_audit": dg.MetadataValue.md(_table(audit)),
        "units_that_drift": int(audit["drifts"].sum()),
    }


def _longest_cruise(samples: pl.DataFrame) -> pl.DataFrame:
    """Select the cruise of the flight and pack with the most samples: continuous logs first."""
    cruise = samples.filter(pl.col("monitored") & (pl.col("phase") == "cruise")).drop_nulls("hx_out_k")
    ranked = cruise.group_by(FLIGHT_PACK).agg(pl.col("n_averaged").max(), pl.len().alias("n"))
    best = ranked.sort(pl.col("n_averaged") > 1, "n", *FLIGHT_PACK, descending=True).head(1)
    return cruise.join(best.select(FLIGHT_PACK), on=FLIGHT_PACK, how="semi")


def _table(frame: pl.DataFrame) -> str:
    """Format a small table as Markdown."""
    cells = [[f"{v:.4g}" if isinstance(v, float) else str(v) for v in row] for row in frame.rows()]
    lines = [frame.columns, ["---"] * frame.width, *cells]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
