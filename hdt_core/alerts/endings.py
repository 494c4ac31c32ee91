"""End cases: by work on their component, or by an inspection without a finding.

An engineer who closes an alert writes an entry of the same form (`raw_maintenance`) as work has. Where the loss keeps
growing after an inspection without a finding, the sensors behind the estimate are suspect and a sensor case is raised.
"""

from collections.abc import Iterable, Iterator
from datetime import datetime
from typing import Any

import numpy as np
import polars as pl

from hdt_core.alerts.cases import Case, Grid, Limits, alert_id_of, fact_after, runs, sensor_of
from hdt_core.alerts.diagnoses import DIAGNOSES, LOSS
from hdt_core.alerts.diagnosis import Diagnosis
from hdt_core.alerts.wear import RISE_MARGIN
from hdt_core.components.declaration import INSPECTED, NO_FAULT
from hdt_core.health.detection import persistent
from hdt_core.records.keys import PACK
from hdt_core.records.unit_index import date_entries, select_entries
from hdt_core.robust import Array

INSPECTIONS = (INSPECTED,)
RENEWED, FOUND_CLEAN = "renewed", "found_clean"


def close_after_work(
    grid: Grid,
    maintenance: pl.DataFrame,
    cases: list[Case],
    diagnoses: Iterable[Diagnosis[Any]] = tuple(DIAGNOSES.values()),
) -> list[Case]:
    """Close each case at work on its component, whatever later flights show.

    The case ends on the first flight that counts as flown after the work (`records.unit_index`), however late the entry
    arrived; where no flight has followed yet, at the time from which the entry counts.
    """
    sound_entries = _sound_entries(maintenance)
    for diagnosis in diagnoses:
        own = [case for case in cases if case.diagnosis == diagnosis.code]
        if own:
            _close(grid, own, maintenance, diagnosis.component, diagnosis.ended_by, RENEWED)
            if diagnosis.ended_by_sound:
                _close(grid, own, sound_entries, diagnosis.component, INSPECTIONS, FOUND_CLEAN)
    if "closes_alert_id" in sound_entries.columns:
        closings = sound_entries.drop_nulls("closes_alert_id")
        for case in cases if closings.height else []:
            entries = closings.filter(_closes(grid, case))
            if entries.height:
                _close(grid, [case], entries, case.component, INSPECTIONS, FOUND_CLEAN)
    return cases


def _closes(grid: Grid, case: Case) -> pl.Expr:
    """Select closings of this case: of its diagnosis and sensor, as its id may have changed since, or of its id."""
    same_sensor = pl.col("closes_sensor").eq_missing(pl.lit(sensor_of(case), pl.String))
    same_kind = (pl.col("closes_diagnosis") == case.diagnosis) & same_sensor
    return same_kind | (pl.col("closes_alert_id") == alert_id_of(grid, case))


def _sound_entries(maintenance: pl.DataFrame) -> pl.DataFrame:
    """Return the entries without a finding."""
    return maintenance.filter(finding=NO_FAULT) if "finding" in maintenance.columns else maintenance.clear()


def _close(
    grid: Grid, cases: list[Case], entries: pl.DataFrame, component: str, actions: tuple[str, ...], reason: str
) -> None:
    """Close cases on the first flight after such an entry, or at its moment where none has flown since."""
    work = grid.worked_on(entries, (component,), actions)
    moments = _moments_after_last_flight(grid, entries, component, actions)
    for case in cases:
        later = case.raised_flight + 1 + np.flatnonzero(work[case.unit, case.raised_flight + 1 :])
        # of two entries that count from one flight, a replacement is the reason
        last_flight = np.inf if case.closed_flight is None else case.closed_flight - (reason != RENEWED)
        if later.size and later[0] <= last_flight:
            case.closed_flight, case.closed_reason = int(later[0]), reason
        moment = moments.get(case.unit)
        if moment is not None and (case.ended_at is None or moment < case.ended_at):
            case.ended_at = moment
            case.ended_reason = reason


def _moments_after_last_flight(
    grid: Grid, entries: pl.DataFrame, component: str, actions: tuple[str, ...]
) -> dict[int, datetime]:
    """Return, by unit with such work since its last flight, the time from which the first entry counts."""
    last = grid.rows.group_by(PACK).agg(last_at=pl.col("departed_at").max())
    last = last.join(grid.units.with_row_index("unit"), on=PACK, validate="1:1")
    later = select_entries(entries, (component,), actions).join(last, on=PACK, validate="m:1")
    later = later.filter(pl.col("counts_from") > pl.col("last_at"))
    return dict(later.group_by("unit").agg(pl.col("counts_from").min()).rows())


def apply_inspections(grid: Grid, maintenance: pl.DataFrame, cases: list[Case], limits: Limits) -> list[Case]:
    """Drop cases of a loss that an inspection has cleared, and add sensor cases where that loss grows on.

    After an inspection without a finding, growth of the loss by `wear.RISE_MARGIN` raises a sensor case; wear is called
    again only for a growth that would raise a case on a new part.
    """
    cleared_cases = [case for case in cases if case.closed_reason == FOUND_CLEAN and case.diagnosis in LOSS]
    for case in cleared_cases:
        start, end, level = _span(grid, maintenance, case)
        loss = grid.track(LOSS[case.diagnosis], case.unit)
        cases = [c for c in cases if not _same_loss(c, case, (start, end), loss - level, limits)]
    contradictions = [c for case in cleared_cases for c in _contradictions(grid, maintenance, case, limits)]
    return cases + close_after_work(grid, maintenance, contradictions)


def _span(grid: Grid, maintenance: pl.DataFrame, case: Case) -> tuple[int, int, float]:
    """Return the first flight after the inspection, that of the next unit, and the loss at the inspection."""
    loss = grid.track(LOSS[case.diagnosis], case.unit)
    start = min(case.closed_flight or 0, loss.size)
    diagnosis = DIAGNOSES[case.diagnosis]
    new_unit = grid.worked_on(maintenance, (diagnosis.component,), diagnosis.ended_by)[case.unit, start : loss.size]
    end = start + int(np.flatnonzero(new_unit)[0]) if new_unit.any() else loss.size
    before = loss[:start][np.isfinite(loss[:start])]
    return start, end, float(before[-1]) if before.size else np.nan


def _same_loss(other: Case, case: Case, span: tuple[int, int], growth: Array, limits: Limits) -> bool:
    """Check whether `other` is raised on the inspected unit for no more loss than the inspection cleared."""
    kind = DIAGNOSES[other.diagnosis]
    limit = kind.limit if kind.is_wear else None
    inside = other.unit == case.unit and span[0] <= other.raised_flight < span[1]
    if limit is None or not inside or other.component != case.component:
        return False
    return not growth[other.raised_flight] > getattr(limits, limit)


def _contradictions(grid: Grid, maintenance: pl.DataFrame, case: Case, limits: Limits) -> Iterator[Case]:
    """Yield a sensor case for each period in which the loss of a part without a finding has grown on."""
    start, end, level = _span(grid, maintenance, case)
    loss = grid.track(LOSS[case.diagnosis], case.unit)
    growth = (loss[start:end] - level)[None]
    has_grown = persistent(growth > RISE_MARGIN, *limits.wear_persistence, keep=growth > 0.5 * RISE_MARGIN)
    facts = {
        "kind": "contradicted", "since": start, "of": case.component, "level": level,
        "looked_on": _inspection_day(grid, maintenance, case), "follows": alert_id_of(grid, case),
    }  # fmt: skip
    for _, first, stop in runs(has_grown, np.zeros_like(has_grown)):
        last = end if end < loss.size else None
        closed_flight = last if stop is None else start + stop
        reason = RENEWED if stop is None and last is not None else "recovered"
        yield Case(
            case.unit, "SENSOR", "SENSOR_FAULT", start + first, closed_flight, facts, fact_after("loss", loss),
            closed_reason=reason,
        )  # fmt: skip


def _inspection_day(grid: Grid, maintenance: pl.DataFrame, case: Case) -> str:
    """Return the day of the inspection that ended the case."""
    operator, tail, pack = grid.units.row(case.unit)
    until: pl.Expr = pl.lit(grid.value("departed_at", case.unit, int(case.closed_flight or 0)))
    own = _sound_entries(maintenance).filter(operator=operator, tail=tail, pack=pack, component=case.component)
    days = date_entries(own).filter(pl.col("counts_from") <= until, pl.col("action").is_in(INSPECTIONS))["done_on"]
    return str(days.max())
