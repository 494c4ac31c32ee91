"""Classify flights and samples as nominal, or give the reason why not."""

import polars as pl

from hdt_core.flight.admission import NominalBaseline, admit
from hdt_core.flight.legs import judge_legs, reject_odd_bleed
from pipelines.assets.calibration import LEGS, laws_of
from pipelines.assets.stage import stage


@stage
def legs(raw_snapshots: pl.DataFrame, raw_logs: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Classify each leg by its own record alone: phase, completeness, range, steady state."""
    verdicts, samples = judge_legs(pl.concat([raw_snapshots, raw_logs]))
    return samples, verdicts


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
