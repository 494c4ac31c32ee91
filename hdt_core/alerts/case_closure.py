"""Close cases by the maintenance log: a part replaced or repaired, or an inspection without a finding.

The log's entries and those of an engineer who closes an alert have one form (`raw_maintenance`), so one rule serves
both. Where the loss keeps growing after an inspection without a finding, the sensors behind the estimate are suspect
and a sensor case is raised.
"""

from collections.abc import Iterable, Iterator
from datetime import datetime

import numpy as np
import polars as pl

from hdt_core.alerts.cases import Case, Limits, case_id, fact_after, runs
from hdt_core.alerts.diagnoses import DIAGNOSES, Diagnosis
from hdt_core.alerts.grid import Grid
from hdt_core.health.detection import Array, persistent
from hdt_core.records.keys import PACK
from hdt_core.records.unit_index import date_entries, select_entries

NO_FAULT, INSPECTIONS = "NO_FAULT_FOUND", ("INSPECTED",)
RENEWED, FOUND_CLEAN = "renewed", "found_clean"
LOSS = {"HX_FOULING": "hx_fouling", "HX_SUDDEN_CLOG": "hx_fouling", "CC_DEGRADED": "cc_efficiency_loss"}
"""Feature of the loss that a case of wear rests on."""
LOSS_GROWTH = 0.03
"""Growth of loss since an inspection beyond the scatter of a settled track: as `wear.RISE_MARGIN`. [-]"""
WEAR_LIMIT = {"HX_FOULING": "fouling", "CC_DEGRADED": "compressor"}
"""Limit of `Limits` that the growth since the inspection must exceed before wear is called again."""


def close_after_work(
    grid: Grid, maintenance: pl.DataFrame, cases: list[Case], diagnoses: Iterable[Diagnosis] = tuple(DIAGNOSES.values())
) -> list[Case]:
    """Close each case at work on its component, whatever later flights show.

    The case ends on the first flight that counts as flown after the work (`records.unit_index`), however late the entry
    arrived; where no flight has followed yet, at the time from which the entry counts.
    """
    sound = _sound_entries(maintenance)
    for diagnosis in diagnoses:
        own = [case for case in cases if case.diagnosis == diagnosis.code]
        if own:
            _close(grid, own, maintenance, diagnosis.component, diagnosis.ended_by, RENEWED)
            if diagnosis.ended_by_sound:
                _close(grid, own, sound, diagnosis.component, INSPECTIONS, FOUND_CLEAN)
    if "closes_alert_id" in sound.columns and (closed_ids := set(sound["closes_alert_id"].drop_nulls())):
        for case in cases:
            if (name := case_id(grid, case)) in closed_ids:
                _close(grid, [case], sound.filter(closes_alert_id=name), case.component, INSPECTIONS, FOUND_CLEAN)
    return cases


def _sound_entries(maintenance: pl.DataFrame) -> pl.DataFrame:
    """Return the entries without a finding."""
    return (
        maintenance.filter(pl.col("finding") == NO_FAULT) if "finding" in maintenance.columns else maintenance.clear()
    )


def _close(
    grid: Grid, cases: list[Case], entries: pl.DataFrame, component: str, actions: tuple[str, ...], reason: str
) -> None:
    """Close cases on the first flight after such an entry, or at its moment where none has flown since."""
    work = grid.worked_on(entries, (component,), actions)
    moments = _moments_after_last_flight(grid, entries, component, actions)
    for case in cases:
        later = case.raised_flight + 1 + np.flatnonzero(work[case.unit, case.raised_flight + 1 :])
        earlier = reason == RENEWED  # of two entries on one flight the more specific
        if later.size and (
            case.closed_flight is None or case.closed_flight > later[0] or (earlier and case.closed_flight == later[0])
        ):
            case.closed_flight, case.closed_reason = int(later[0]), reason
        at = moments.get(case.unit)
        if at is not None and (case.ended_at is None or at < case.ended_at):
            case.ended_at, case.ended_reason = at, reason


def _moments_after_last_flight(
    grid: Grid, entries: pl.DataFrame, component: str, actions: tuple[str, ...]
) -> dict[int, datetime]:
    """Return, by unit with such work since its last flight, the time from which the first entry counts."""
    last = (
        grid.rows.select(*PACK, "departed_at", pl.Series("unit", grid.unit))
        .group_by(*PACK, "unit")
        .agg(pl.col("departed_at").max())
    )
    after_flight = select_entries(entries, (component,), actions).join(last, on=PACK, validate="m:m")
    later = (
        after_flight.filter(pl.col("counts_from") > pl.col("departed_at"))
        .group_by("unit")
        .agg(pl.col("counts_from").min())
    )
    return dict(later.select("unit", "counts_from").rows())


def apply_inspections(grid: Grid, maintenance: pl.DataFrame, cases: list[Case], limits: Limits) -> list[Case]:
    """Drop cases of a loss that an inspection has cleared, and add sensor cases where that loss grows on.

    After an inspection without a finding, growth of the loss by `LOSS_GROWTH` raises a sensor case; wear is called
    again only for a growth that would raise a case on a new part.
    """
    inspected = [case for case in cases if case.closed_reason == FOUND_CLEAN and case.diagnosis in LOSS]
    for case in inspected:
        start, end, level = _span(grid, maintenance, case)
        loss = grid.track(LOSS[case.diagnosis], case.unit)
        cases = [c for c in cases if not _same_loss(c, case, (start, end), loss - level, limits)]
    back = [c for case in inspected for c in _contradictions(grid, maintenance, case, limits)]
    return cases + close_after_work(grid, maintenance, back)


def _span(grid: Grid, maintenance: pl.DataFrame, case: Case) -> tuple[int, int, float]:
    """Return the first flight after the inspection, that of the next unit, and the loss at the inspection."""
    loss = grid.track(LOSS[case.diagnosis], case.unit)
    start = min(case.closed_flight or 0, loss.size)
    diagnosis = DIAGNOSES[case.diagnosis]
    renewed = grid.worked_on(maintenance, (diagnosis.component,), diagnosis.ended_by)[case.unit, start : loss.size]
    end = start + int(np.flatnonzero(renewed)[0]) if renewed.any() else loss.size
    before = loss[:start][np.isfinite(loss[:start])]
    return start, end, float(before[-1]) if before.size else np.nan


def _same_loss(other: Case, case: Case, span: tuple[int, int], growth: Array, limits: Limits) -> bool:
    """Whether `other` is raised on the inspected unit for no more loss than the inspection cleared."""
    limit = WEAR_LIMIT.get(other.diagnosis)
    inside = other.unit == case.unit and span[0] <= other.raised_flight < span[1]
    if limit is None or not inside or other.component != case.component:
        return False
    return not growth[other.raised_flight] > getattr(limits, limit)


def _contradictions(grid: Grid, maintenance: pl.DataFrame, case: Case, limits: Limits) -> Iterator[Case]:
    """Yield a sensor case for each period in which the loss of a part without a finding has grown on."""
    start, end, level = _span(grid, maintenance, case)
    loss = grid.track(LOSS[case.diagnosis], case.unit)
    growth = (loss[start:end] - level)[None]
    on = persistent(growth > LOSS_GROWTH, *limits.wear_persistence, keep=growth > 0.5 * LOSS_GROWTH)
    facts = {
        "kind": "contradicted", "since": start, "of": case.component, "level": level,
        "looked_on": _inspection_day(grid, maintenance, case), "follows": case_id(grid, case),
    }  # fmt: skip
    for _, first, stop in runs(on, np.zeros_like(on)):
        last = end if end < loss.size else None
        closed_flight = last if stop is None else start + stop
        reason = RENEWED if stop is None and last is not None else "recovered"
        sensor_case = Case(
            case.unit, "SENSOR", "SENSOR_FAULT", start + first, closed_flight, facts, fact_after("loss", loss)
        )
        sensor_case.closed_reason = reason
        yield sensor_case


def _inspection_day(grid: Grid, maintenance: pl.DataFrame, case: Case) -> str:
    """Return the day of the inspection that ended the case."""
    operator, tail, pack = grid.units.row(case.unit)
    by: pl.Expr = pl.lit(grid.at("departed_at", case.unit, int(case.closed_flight or 0)))
    own = _sound_entries(maintenance).filter(operator=operator, tail=tail, pack=pack, component=case.component)
    days = date_entries(own).filter(pl.col("counts_from") <= by, pl.col("action").is_in(INSPECTIONS))["done_on"]
    return str(days.max())
