"""What ends a case beside the belief itself: work after which another part flies, and an inspection that found nothing.

A maintenance log and an engineer who closes an alert say it in the same words (`raw_maintenance`), so one rule answers
for both. A part that was found sound ends its case; where the loss grows on all the same, the part is not what changes,
and the case comes back as one of the sensors that the loss is judged by.
"""

from collections.abc import Callable, Iterable, Iterator
from datetime import datetime

import numpy as np
import polars as pl

from hdt_core.alerts.cases import Case, Limits, case_id, spells
from hdt_core.alerts.diagnoses import DIAGNOSES, Diagnosis
from hdt_core.alerts.grid import Grid
from hdt_core.health.detection import Array, persistent
from hdt_core.records.keys import PACK
from hdt_core.records.unit_index import date_entries, select_entries

SOUND, LOOKED = "NO_FAULT_FOUND", ("INSPECTED",)
RENEWED, FOUND_CLEAN = "renewed", "found_clean"
LOSS = {"HX_FOULING": "hx_fouling", "HX_SUDDEN_CLOG": "hx_fouling", "CC_DEGRADED": "cc_efficiency_loss"}
"""The loss that a case of wear rests on."""
GROWN = 0.03
"""Loss gained since an inspection that a settled track does not show by chance: as `wear.RISE_MARGIN`. [-]"""
AGAIN = {"HX_FOULING": "fouling", "CC_DEGRADED": "compressor"}
"""Limit that the loss since the inspection must pass before wear is believed again."""


def end_with_the_unit(
    grid: Grid, maintenance: pl.DataFrame, cases: list[Case], diagnoses: Iterable[Diagnosis] = tuple(DIAGNOSES.values())
) -> list[Case]:
    """Close every case where work on its component ends it, whatever is seen of the pack from then on.

    The case ends on the first flight that counts as flown after the work (`records.unit_index`), however late the entry
    came; where none has followed yet, at the moment from which the entry counts.
    """
    sound = _sound(maintenance)
    for said in diagnoses:
        own = [case for case in cases if case.diagnosis == said.code]
        if own:
            _end(grid, own, maintenance, said.component, said.ended_by, RENEWED)
            if said.ended_by_sound:
                _end(grid, own, sound, said.component, LOOKED, FOUND_CLEAN)
    if "closes_alert_id" in sound.columns and (named := set(sound["closes_alert_id"].drop_nulls())):
        for case in cases:
            if (name := case_id(grid, case)) in named:
                _end(grid, [case], sound.filter(closes_alert_id=name), case.component, LOOKED, FOUND_CLEAN)
    return cases


def _sound(maintenance: pl.DataFrame) -> pl.DataFrame:
    """Entries that say that nothing was found."""
    return maintenance.filter(pl.col("finding") == SOUND) if "finding" in maintenance.columns else maintenance.clear()


def _end(
    grid: Grid, cases: list[Case], entries: pl.DataFrame, component: str, actions: tuple[str, ...], reason: str
) -> None:
    """Close cases on the first flight after such an entry, or at its moment where none has flown since."""
    ended = grid.worked_on(entries, (component,), actions)
    waiting = _unflown(grid, entries, component, actions)
    for case in cases:
        later = case.raised + 1 + np.flatnonzero(ended[case.unit, case.raised + 1 :])
        earlier = reason == RENEWED  # that of two on one flight which says more
        if later.size and (case.closed is None or case.closed > later[0] or (earlier and case.closed == later[0])):
            case.closed, case.closed_reason = int(later[0]), reason
        at = waiting.get(case.unit)
        if at is not None and (case.ended_at is None or at < case.ended_at):
            case.ended_at, case.ended_reason = at, reason


def _unflown(grid: Grid, entries: pl.DataFrame, component: str, actions: tuple[str, ...]) -> dict[int, datetime]:
    """Of units worked on since their last flight, the moment from which the first such entry counts."""
    last = (
        grid.rows.select(*PACK, "departed_at", pl.Series("unit", grid.unit))
        .group_by(*PACK, "unit")
        .agg(pl.col("departed_at").max())
    )
    found = select_entries(entries, (component,), actions).join(last, on=PACK, validate="m:m")
    later = (
        found.filter(pl.col("counts_from") > pl.col("departed_at")).group_by("unit").agg(pl.col("counts_from").min())
    )
    return dict(later.select("unit", "counts_from").rows())


def answer_findings(grid: Grid, maintenance: pl.DataFrame, cases: list[Case], limits: Limits) -> list[Case]:
    """Cases after inspections had their say: what was found sound is not called worn again for the same loss.

    Wear that an inspection did not find comes back as a case of the sensors once its loss has grown by `GROWN`, and as
    wear only once it has grown by as much as makes a case of a new part.
    """
    found = [case for case in cases if case.closed_reason == FOUND_CLEAN and case.diagnosis in LOSS]
    for case in found:
        start, end, level = _span(grid, maintenance, case)
        loss = grid.track(LOSS[case.diagnosis], case.unit)
        cases = [c for c in cases if not _same_loss(c, case, (start, end), loss - level, limits)]
    back = [c for case in found for c in _contradictions(grid, maintenance, case)]
    return cases + end_with_the_unit(grid, maintenance, back)


def _span(grid: Grid, maintenance: pl.DataFrame, case: Case) -> tuple[int, int, float]:
    """First flight after the inspection, first flight of the next unit, and the loss at the inspection."""
    loss = grid.track(LOSS[case.diagnosis], case.unit)
    start = min(case.closed or 0, loss.size)
    said = DIAGNOSES[case.diagnosis]
    renewed = grid.worked_on(maintenance, (said.component,), said.ended_by)[case.unit, start : loss.size]
    end = start + int(np.flatnonzero(renewed)[0]) if renewed.any() else loss.size
    before = loss[:start][np.isfinite(loss[:start])]
    return start, end, float(before[-1]) if before.size else np.nan


def _same_loss(other: Case, case: Case, span: tuple[int, int], grown: Array, limits: Limits) -> bool:
    """Whether a case is raised on the unit that was found sound, for no more than what was seen then."""
    limit = AGAIN.get(other.diagnosis)
    inside = other.unit == case.unit and span[0] <= other.raised < span[1]
    if limit is None or not inside or other.component != case.component:
        return False
    return not grown[other.raised] > getattr(limits, limit)


def _contradictions(grid: Grid, maintenance: pl.DataFrame, case: Case) -> Iterator[Case]:
    """Spells in which the loss of a part that was found sound has grown on: three of four flights say so."""
    start, end, level = _span(grid, maintenance, case)
    loss = grid.track(LOSS[case.diagnosis], case.unit)
    grown = (loss[start:end] - level)[None]
    on = persistent(grown > GROWN, 3, 4, 15, keep=grown > 0.5 * GROWN)
    facts = {
        "kind": "contradicted", "since": start, "of": case.component, "level": level,
        "looked_on": _looked_on(grid, maintenance, case), "follows": case_id(grid, case),
    }  # fmt: skip
    for _, first, stop in spells(on, np.zeros_like(on)):
        last = end if end < loss.size else None
        closed = last if stop is None else start + stop
        reason = RENEWED if stop is None and last is not None else "recovered"
        back = Case(case.unit, "SENSOR", "SENSOR_FAULT", start + first, closed, facts, _reader(loss))
        back.closed_reason = reason
        yield back


def _reader(loss: Array) -> Callable[[int], dict[str, float]]:
    """Gives the loss after any flight. `loss` (flights,)."""
    return lambda flight: {"loss": float(loss[flight])}


def _looked_on(grid: Grid, maintenance: pl.DataFrame, case: Case) -> str:
    """Day of the inspection that ended the case."""
    operator, tail, pack = grid.units.row(case.unit)
    by: pl.Expr = pl.lit(grid.at("departed_at", case.unit, int(case.closed or 0)))
    own = _sound(maintenance).filter(operator=operator, tail=tail, pack=pack, component=case.component)
    days = date_entries(own).filter(pl.col("counts_from") <= by, pl.col("action").is_in(LOOKED))["done_on"]
    return str(days.max())
