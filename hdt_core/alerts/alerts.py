"""Alerts of a fleet: all cases as rows of the catalog, also with one limit higher or lower."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from copy import copy
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Any

import polars as pl

from hdt_core.alerts import phrases
from hdt_core.alerts.cases import REPAIR, Case, Grid, Limits, alert_id_of, open_flights, sensor_of
from hdt_core.alerts.diagnoses import DIAGNOSES
from hdt_core.alerts.diagnosis import Diagnosis
from hdt_core.alerts.disturbances import Disturbances, door_cases, find_disturbances
from hdt_core.alerts.endings import apply_inspections, close_after_work
from hdt_core.alerts.text import Figures, Text, TextList, to_json
from hdt_core.alerts.wear import cc_cases, hx_cases, low_margin_cases
from hdt_core.records.keys import PACK
from hdt_core.records.unit_index import NEW_UNIT, select_entries
from hdt_core.tables.alerts import FeaturesAlerts

REPEAT_DAYS = 90
"""Days within which units of one position are counted."""
REPEAT_UNITS = 3
"""Units at one position within `REPEAT_DAYS` from which the cause upstream is to be found before another is fitted."""

Replacements = dict[tuple[Any, ...], list[datetime]]
"""By component and pack, the times from which another unit was fitted."""


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
        return FeaturesAlerts.create_empty()
    limits = limits or Limits()
    grid = Grid.from_frame(features)
    # doors first, then sensors, then wear: what a faulty door or sensor explains is not called wear
    disturbances = find_disturbances(grid, maintenance, limits)
    cases = disturbances.cases + wear_cases(grid, maintenance, limits, disturbances)
    rules = [kind.rule for kind in DIAGNOSES.values() if kind.rule]
    cases += [case for rule in rules for case in rule(grid, maintenance, limits, disturbances)]
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
    schema = FeaturesAlerts.create_empty().schema
    alerts = pl.DataFrame(rows, schema=schema).unique("alert_id", keep="first", maintain_order=True)
    return alerts.sort("raised_at", "tail", "pack", "alert_id")


def wear_cases(grid: Grid, maintenance: pl.DataFrame, limits: Limits, disturbances: Disturbances) -> list[Case]:
    """Find wear that no door and no sensor explains."""
    compressors = cc_cases(grid, maintenance, limits, disturbances.sensor_faulty)
    low = low_margin_cases(grid, maintenance, limits, disturbances.outlet_doubtful | disturbances.wear_feigned)
    exchangers = hx_cases(grid, maintenance, limits, disturbances.wear_doubtful, open_flights(grid.shape, low))
    return exchangers + low + compressors


def _alert_row(grid: Grid, replacements: Replacements, case: Case, kind: Diagnosis[Any]) -> dict[str, Any]:
    """Return a case as a row of `FeaturesAlerts`."""
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
    return {
        "alert_id": alert_id_of(grid, case),
        "operator": operator,
        "tail": tail,
        "pack": pack,
        "component": case.component,
        "diagnosis": case.diagnosis,
        "sensor": sensor_of(case),
        "raised_flight_id": grid.value("flight_id", case.unit, case.raised_flight),
        "raised_at": grid.value("departed_at", case.unit, case.raised_flight),
        "closed_at": case.ended_at if end is None else grid.value("departed_at", case.unit, end),
        "severity": kind.severity(latest),
        "evidence": at_first.text(),
        "evidence_phrases": at_first.to_json(),
        "recommended_action": action,
        "action_phrases": to_json(action),
        "raised_severity": kind.severity(at_raise),
        "now_flight_id": grid.value("flight_id", case.unit, last),
        "evidence_now": now.text(),
        "evidence_now_phrases": now.to_json(),
        "closed_reason": case.ended_reason if end is None else case.closed_reason,
        "follows": case.facts.get("follows"),
        "units_in_90_days": units,
    }


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
    for diagnosis, kind in DIAGNOSES.items():
        name = str(kind.limit)
        for value in kind.limit_values:
            change: dict[str, Any] = {name: value}
            new_limits = replace(limits, **change)
            if diagnosis == "RAM_DOOR_FAULT":
                cases = door_cases(grid, maintenance, new_limits)
            else:  # copies, because `as_alerts` sets where a case ends
                cases = [*map(copy, disturbances.cases), *wear_cases(grid, maintenance, new_limits, disturbances)]
            alerts = as_alerts(grid, maintenance, cases, new_limits)
            yield Trial(diagnosis, name, value, value == getattr(limits, name), alerts)
