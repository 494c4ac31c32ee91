"""Diagnoses of alerts, each declared once: its component, texts, action, and the work that closes its cases.

To add one, declare it here and write a rule that finds its cases (`alerts.raise_alerts`); report, `hdt explain`,
catalog and the check of alerts follow from the declaration.

An engineer who closes an alert writes an entry of the same form (`raw_maintenance`) as work has. Where the loss keeps
growing after an inspection without a finding, the sensors behind the estimate are suspect and a sensor case is raised.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Generic, TypeVar

import numpy as np
import polars as pl

from hdt_core.alerts import evidence
from hdt_core.alerts.cases import REPAIR, Case, Grid, Limits, alert_id_of, fact_after, runs, sensor_of
from hdt_core.alerts.evidence import Evidence
from hdt_core.alerts.facts import CompressorFacts, DoorFacts, ExchangerFacts, Facts, MarginFacts, SensorFacts
from hdt_core.alerts.text import Text
from hdt_core.alerts.wear import RISE_MARGIN
from hdt_core.components.declaration import INSPECTED, NO_FAULT
from hdt_core.components.pack import CC, HX
from hdt_core.health.detection import persistent
from hdt_core.records.keys import PACK
from hdt_core.records.unit_index import date_entries, select_entries
from hdt_core.robust import Array

F = TypeVar("F", bound=Facts)


@dataclass(frozen=True, slots=True)
class Diagnosis(Generic[F]):
    """One kind of case: its texts, its action and what ends it.

    Attributes
    ----------
    code, component, name : str
        As in the catalog; the component as in the log of work; the name in plain words.
    action : str
        What to do, with its ATA task.
    ended_by : tuple of str
        Actions on the component that end the case, because another or a repaired part is fitted.
    record : type
        Facts that severity and evidence rest on.
    severity : callable
        `low`, `medium` or `high` by the facts of a moment.
    evidence : callable
        Evidence by the facts of a moment and the flight since which the finding holds.
    addendum : callable, optional
        Texts that the facts add to the action.
    ended_by_sound : bool
        Whether an inspection of the component without a finding ends the case.
    """

    code: str
    component: str
    name: str
    action: str
    ended_by: tuple[str, ...]
    record: type[F]
    severity: Callable[[F], str]
    evidence: Callable[[F, str], Evidence]
    addendum: Callable[[F], tuple[Text, ...]] = lambda facts: ()
    ended_by_sound: bool = True

    def facts(self, grid: Grid, case: Case, flight: int) -> F:
        """Return the facts after a flight: those the case was raised with, and the latest features."""
        own = case.facts | case.facts_at(flight)
        return self.record.collect(own, lambda name: _latest(grid, name, case, flight))


def _latest(grid: Grid, name: str, case: Case, flight: int) -> float:
    """Return the last value of a feature from the flight that raised the case to `flight`."""
    values = grid.track(name, case.unit)[case.raised_flight : flight + 1]
    values = values[np.isfinite(values)]
    return float(values[-1]) if values.size else np.nan


DIAGNOSES: dict[str, Diagnosis[Any]] = {
    d.code: d
    for d in (
        Diagnosis(
            code="HX_FOULING",
            component="HX",
            name="heat exchanger fouling",
            action=HX.action,
            ended_by=HX.ended_by,
            record=ExchangerFacts,
            severity=evidence.exchanger_severity,
            evidence=evidence.exchanger,
        ),
        Diagnosis(
            code="HX_SUDDEN_CLOG",
            component="HX",
            name="heat exchanger clogged suddenly",
            action="Inspect ram air inlet and core face for foreign objects before the next long sector "
            "(ATA 21-52, detailed visual inspection)",
            ended_by=HX.ended_by,
            record=ExchangerFacts,
            severity=lambda facts: "high",
            evidence=evidence.clog,
        ),
        Diagnosis(
            code="HX_LOW_MARGIN",
            component="HX",
            name="little cooling margin left",
            action="Check outlet target, flow schedule and ram door travel (ATA 21-53, rigging); a new exchanger "
            "alone does not remove the cause; keep the aircraft off hot sectors where it can be, and wash at the next "
            "stop",
            ended_by=HX.ended_by,
            record=MarginFacts,
            severity=lambda facts: "high" if facts.hx_passage_100 > 0.5 else "medium",
            evidence=evidence.low_margin,
            ended_by_sound=False,  # its evidence already excludes wear as the only cause
        ),
        Diagnosis(
            code="CC_DEGRADED",
            component="CC",
            name="compressor worn",
            action=CC.action,
            ended_by=CC.ended_by,
            record=CompressorFacts,
            severity=lambda facts: "medium",
            evidence=evidence.compressor,
        ),
        Diagnosis(
            code="RAM_DOOR_FAULT",
            component="RAM_DOOR",
            name="ram air door fault",
            action="Operational test of the ram air inlet door and its actuator (ATA 21-53); rig or replace",
            ended_by=REPAIR,
            record=DoorFacts,
            severity=lambda facts: "high" if facts.kind == "jam" else "medium",
            evidence=evidence.door,
        ),
        Diagnosis(
            code="SENSOR_FAULT",
            component="SENSOR",
            name="sensor fault",
            action="Check connector and wiring, then replace the sensor (ATA 21-61)",
            ended_by=REPAIR,
            record=SensorFacts,
            severity=evidence.sensor_severity,
            evidence=evidence.sensor,
            addendum=evidence.sensor_addendum,
        ),
    )
}


INSPECTIONS = (INSPECTED,)
RENEWED, FOUND_CLEAN = "renewed", "found_clean"
LOSS = {"HX_FOULING": "hx_fouling", "HX_SUDDEN_CLOG": "hx_fouling", "CC_DEGRADED": "cc_efficiency_loss"}
"""Feature of the loss that a case of wear rests on."""
LIMIT_NAMES = {"HX_FOULING": "fouling", "CC_DEGRADED": "compressor"}
"""Limit of `Limits` that the growth since the inspection must exceed before wear is called again."""


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
    limit = LIMIT_NAMES.get(other.diagnosis)
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
