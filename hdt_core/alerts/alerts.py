"""Alerts of a fleet: all cases as rows of the catalog, also with one limit higher or lower, and those of declared
components: one loss, its trend, and whether it exceeds the limit to plan for.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from copy import copy
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Any

import numpy as np
import polars as pl

from hdt_core.alerts import phrases
from hdt_core.alerts.cases import REPAIR, Case, Grid, Limits, alert_id_of, open_flights, runs, sensor_of
from hdt_core.alerts.diagnoses import DIAGNOSES, Diagnosis, apply_inspections, close_after_work
from hdt_core.alerts.disturbances import Disturbances, door_cases, find_disturbances
from hdt_core.alerts.evidence import HIGH_SEVERITY_SHARE, declared_loss
from hdt_core.alerts.facts import LossFacts
from hdt_core.alerts.text import Figures, Text, TextList, to_json
from hdt_core.alerts.wear import cc_cases, hx_cases, low_margin_cases, odds_above
from hdt_core.components import Component
from hdt_core.health.detection import persistent
from hdt_core.health.features import features
from hdt_core.records.keys import LEG_AT, PACK
from hdt_core.records.unit_index import NEW_UNIT, select_entries

REPEAT_DAYS = 90
"""Days within which units of one position are counted."""
REPEAT_UNITS = 3
"""Units at one position within `REPEAT_DAYS` from which the cause upstream is to be found before another is fitted."""

Replacements = dict[tuple[Any, ...], list[datetime]]
"""By component and pack, the times from which another unit was fitted."""

SCHEMA: dict[str, Any] = {
    "alert_id": pl.String, "operator": pl.String, "tail": pl.String, "pack": pl.Int32, "component": pl.String,
    "diagnosis": pl.String, "sensor": pl.String, "raised_flight_id": pl.String, "raised_at": pl.Datetime("us", "UTC"),
    "closed_at": pl.Datetime("us", "UTC"), "severity": pl.String, "evidence": pl.String, "evidence_phrases": pl.String,
    "recommended_action": pl.String, "action_phrases": pl.String, "raised_severity": pl.String,
    "now_flight_id": pl.String, "evidence_now": pl.String, "evidence_now_phrases": pl.String,
    "closed_reason": pl.String, "follows": pl.String, "units_in_90_days": pl.Int64,
}  # fmt: skip


def raise_alerts(features: pl.DataFrame, maintenance: pl.DataFrame, limits: Limits | None = None) -> pl.DataFrame:
    """Raise the alerts of a fleet, one row a case.

    Parameters
    ----------
    features : DataFrame
        `features.features(...)` with the cross-check columns, from which door and sensor faults are detected.
    maintenance : DataFrame
        operator, tail, pack, done_on, component, action, finding. Work on a component ends its cases, and so does
        an inspection without a finding.

    Returns
    -------
    DataFrame
        The columns of the catalog's `alerts`. `alert_id` is a function of the data: `alerts.succession` follows a case.
    """
    if features.is_empty():
        return pl.DataFrame(schema=SCHEMA)
    limits = limits or Limits()
    grid = Grid.from_frame(features)
    # doors first, then sensors, then wear: what a faulty door or sensor explains is not called wear
    disturbances = find_disturbances(grid, maintenance, limits)
    cases = disturbances.cases + wear_cases(grid, maintenance, limits, disturbances)
    return as_alerts(grid, maintenance, cases, limits)


def as_alerts(grid: Grid, maintenance: pl.DataFrame, cases: list[Case], limits: Limits) -> pl.DataFrame:
    """Close cases where work or an inspection ends them and return them as rows of the catalog."""
    cases = apply_inspections(grid, maintenance, close_after_work(grid, maintenance, cases), limits)
    return alert_rows(grid, maintenance, cases, DIAGNOSES)


def alert_rows(
    grid: Grid, maintenance: pl.DataFrame, cases: list[Case], diagnoses: Mapping[str, Diagnosis[Any]]
) -> pl.DataFrame:
    """Return cases as rows of the catalog, in order of the flights that raised them."""
    replacements = _replacement_times(maintenance, {diagnoses[case.diagnosis].component for case in cases})
    rows = [_alert_row(grid, replacements, case, diagnoses[case.diagnosis]) for case in cases]
    alerts = pl.DataFrame(rows, schema=SCHEMA, orient="row").unique("alert_id", keep="first", maintain_order=True)
    return alerts.sort("raised_at", "tail", "pack", "alert_id")


def wear_cases(grid: Grid, maintenance: pl.DataFrame, limits: Limits, disturbances: Disturbances) -> list[Case]:
    """Find wear that no door and no sensor explains."""
    compressors = cc_cases(grid, maintenance, limits, disturbances.sensor_faulty)
    low = low_margin_cases(grid, maintenance, limits, disturbances.outlet_doubtful | disturbances.wear_feigned)
    exchangers = hx_cases(grid, maintenance, limits, disturbances.wear_doubtful, open_flights(grid.shape, low))
    return exchangers + low + compressors


def _alert_row(grid: Grid, replacements: Replacements, case: Case, kind: Diagnosis[Any]) -> tuple[Any, ...]:
    """Return a case as a row of `SCHEMA`."""
    operator, tail, pack = grid.units.row(case.unit)
    n_flights = grid.count(case.unit)
    end = case.closed_flight if case.closed_flight is not None and case.closed_flight < n_flights else None
    last = (n_flights if end is None else end) - 1
    since = str(grid.value("flight_id", case.unit, int(case.facts["since"])))
    at_raise, latest = (kind.facts(grid, case, flight) for flight in (case.raised_flight, last))
    at_first = kind.evidence(at_raise, since)
    now = kind.evidence(latest, since)
    units = _count_units(grid, replacements, case, kind)
    action = TextList([*_action_of(kind, units), *kind.addendum(at_raise)])
    return (
        alert_id_of(grid, case), operator, tail, pack, case.component, case.diagnosis, sensor_of(case),
        grid.value("flight_id", case.unit, case.raised_flight),
        grid.value("departed_at", case.unit, case.raised_flight),
        case.ended_at if end is None else grid.value("departed_at", case.unit, end),
        kind.severity(latest), at_first.text(), at_first.to_json(), action, to_json(action), kind.severity(at_raise),
        grid.value("flight_id", case.unit, last), now.text(), now.to_json(),
        case.ended_reason if end is None else case.closed_reason, case.facts.get("follows"), units,
    )  # fmt: skip


def _replacement_times(maintenance: pl.DataFrame, components: Iterable[str]) -> Replacements:
    """Collect the times of replacement of some components."""
    times: Replacements = defaultdict(list)
    for component in components:
        for *pack, moment in select_entries(maintenance, (component,), NEW_UNIT).select(*PACK, "counts_from").rows():
            times[component, *pack].append(moment)
    return times


def _count_units(grid: Grid, replacements: Replacements, case: Case, kind: Diagnosis[Any]) -> int | None:
    """Count the units at this position in the `REPEAT_DAYS` before the case was raised, its own included.

    None where the log's component is not a single unit: sensors and a door's drive.
    """
    if kind.ended_by == REPAIR:
        return None
    raised_at = grid.value("departed_at", case.unit, case.raised_flight)
    assert isinstance(raised_at, datetime)
    moments = replacements[kind.component, *grid.units.row(case.unit)]
    return 1 + sum(raised_at - timedelta(REPEAT_DAYS) < moment <= raised_at for moment in moments)


def _action_of(kind: Diagnosis[Any], units: int | None) -> list[Text]:
    """Return the action, after a search for the cause where units at a position are replaced too often."""
    action = Text.whole(kind.action)
    if units is None or units < REPEAT_UNITS:
        return [action]
    upstream = Text(phrases.UPSTREAM, units=Figures(str(units)), days=Figures(str(REPEAT_DAYS)))
    return [upstream, Text(phrases.THEN), action.continued()]


VALUES = {
    "HX_FOULING": ("fouling", (0.10, 0.125, 0.15, 0.20, 0.25)),
    "HX_SUDDEN_CLOG": ("clog", (0.07, 0.10, 0.15, 0.20)),
    "HX_LOW_MARGIN": ("passage", (0.70, 0.80, 0.90, 0.95, 0.98)),
    "CC_DEGRADED": ("compressor", (0.03, 0.04, 0.05, 0.07)),
    "RAM_DOOR_FAULT": ("peg_k", (0.9, 1.3, 1.8, 2.5)),
}
"""By diagnosis, the limit (of `Limits`) that decides and its values; the one in service is among them."""


@dataclass(frozen=True, slots=True)
class Trial:
    """All alerts of a fleet with one limit changed."""

    diagnosis: str
    limit: str
    value: float
    in_service: bool
    alerts: pl.DataFrame


def trials(features: pl.DataFrame, maintenance: pl.DataFrame, limits: Limits | None = None) -> Iterator[Trial]:
    """Yield the alerts of a fleet at other limits, one at a time; arguments as of `alerts.raise_alerts`.

    Door and sensor cases are found once and stay fixed while a limit of wear changes.
    """
    if features.is_empty():
        return
    limits = limits or Limits()
    grid = Grid.from_frame(features)
    disturbances = find_disturbances(grid, maintenance, limits)
    for diagnosis, (name, values) in VALUES.items():
        for value in values:
            change: dict[str, Any] = {name: value}
            new_limits = replace(limits, **change)
            if diagnosis == "RAM_DOOR_FAULT":
                cases = door_cases(grid, maintenance, new_limits)
            else:  # copies, because `as_alerts` sets where a case ends
                cases = [*map(copy, disturbances.cases), *wear_cases(grid, maintenance, new_limits, disturbances)]
            alerts = as_alerts(grid, maintenance, cases, new_limits)
            yield Trial(diagnosis, name, value, value == getattr(limits, name), alerts)


KEYS = [*LEG_AT, "flight_index", "flights_seen_of_unit", "flights_since_drop"]
TRENDS = ("sd", "status", "slope_10_per_flight", "slope_30_per_flight", "slope_100_per_flight", "jump_10", "step_3")
"""Columns of the loss beside its value, each prefixed with the loss's name."""


def component_features(
    health: pl.DataFrame, residuals: pl.DataFrame, legs: pl.DataFrame, maintenance: pl.DataFrame, component: Component
) -> pl.DataFrame:
    """Return one row a flight and pack: the loss under the name `loss`, with its trends.

    Parameters
    ----------
    health, residuals, legs : DataFrame
        Of all components; those of this one are taken.
    """
    own = pl.col("component") == component.code
    columns = features(
        health.filter(own), residuals.filter(own), legs.filter(own), maintenance, health=[component.loss]
    )
    trends = [pl.col(f"{component.loss}_{t}").alias(f"loss_{t}") for t in TRENDS if f"{component.loss}_{t}" in columns]
    loss = pl.col(component.loss).alias("loss") if component.loss in columns.columns else pl.lit(None).alias("loss")
    return columns.select(*KEYS, pl.lit(component.code).alias("component"), loss, *trends)


def diagnosis_of(component: Component, limits: Limits) -> Diagnosis[LossFacts]:
    """Return the diagnosis of a worn component, with the texts of its declaration."""
    return Diagnosis(
        code=component.diagnosis,
        component=component.code,
        name=f"{component.name} worn",
        action=component.action,
        ended_by=component.ended_by,
        record=LossFacts,
        severity=lambda facts: "high" if facts.loss > HIGH_SEVERITY_SHARE * component.limit.mean else "medium",
        evidence=lambda facts, since: declared_loss(component, limits, facts, since),
    )


def raise_component_alerts(
    features: pl.DataFrame, maintenance: pl.DataFrame, component: Component, limits: Limits
) -> pl.DataFrame:
    """Raise the alerts of one component, one row a case, in the columns of the catalog's `alerts`.

    Parameters
    ----------
    features : DataFrame
        Of `component_features`.
    maintenance : DataFrame
        Work on the component ends its cases.
    """
    own = features.filter(pl.col("component") == component.code)
    if own.is_empty():
        return pl.DataFrame(schema=SCHEMA)
    grid = Grid.from_frame(own)
    diagnosis = diagnosis_of(component, limits)
    cases = _wear_cases(grid, maintenance, component, limits)
    cases = close_after_work(grid, maintenance, cases, [diagnosis])
    return alert_rows(grid, maintenance, cases, {diagnosis.code: diagnosis})


def _wear_cases(grid: Grid, maintenance: pl.DataFrame, component: Component, limits: Limits) -> list[Case]:
    """Find losses above their limit with enough probability on most recent flights, until long below it."""
    restart = grid.worked_on(maintenance, (component.code,), component.ended_by)
    loss = grid.values("loss")
    sd = grid.values("loss_sd")
    sure = grid.as_observed(odds_above(loss, sd, component.warn_loss) > limits.fouling_odds, "loss", restart)
    keep = np.nan_to_num(loss) > limits.fouling_keep * component.warn_loss
    on = persistent(sure, *limits.wear_persistence, keep=keep, restart=restart)
    return [
        Case(unit, component.code, component.diagnosis, first, end, {"since": _first_flagged(sure[unit], first)})
        for unit, first, end in runs(on, restart)
    ]


def _first_flagged(sure: np.ndarray, first: int) -> int:
    """Return the first flagged of the last four flights up to `first`."""
    recent = np.flatnonzero(sure[max(first - 3, 0) : first + 1])
    return int(max(first - 3, 0) + recent[0]) if recent.size else first
