"""Alerts: all cases of a fleet as rows of the catalog."""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import polars as pl

from hdt_core.alerts import phrases
from hdt_core.alerts.case_closure import answer_findings, end_with_the_unit
from hdt_core.alerts.cases import REPAIR, Case, Limits, case_id, occupied
from hdt_core.alerts.diagnoses import DIAGNOSES, Diagnosis
from hdt_core.alerts.door_faults import door_cases
from hdt_core.alerts.grid import Grid
from hdt_core.alerts.low_margin import low_margin_cases
from hdt_core.alerts.sensor_faults import feigns_wear, outlet_doubtful, sensor_cases
from hdt_core.alerts.wear import cc_cases, hx_cases
from hdt_core.health.detection import Array
from hdt_core.records.keys import LEG, PACK
from hdt_core.records.unit_index import NEW_UNIT, select_entries

REPEAT_DAYS = 90
"""Days within which units of one position are counted."""
REPEAT_UNITS = 3
"""The unit in so many days that asks for another action than the next one: a position that wears one after the other
has a cause that no new unit takes away."""

Came = dict[str, dict[tuple[Any, ...], list[datetime]]]
"""By component and pack, the moments from which another unit was there."""

SCHEMA: dict[str, Any] = {
    "alert_id": pl.String, "operator": pl.String, "tail": pl.String, "pack": pl.Int32, "component": pl.String,
    "diagnosis": pl.String, "raised_flight_id": pl.String, "raised_at": pl.Datetime("us", "UTC"),
    "closed_at": pl.Datetime("us", "UTC"), "severity": pl.String, "evidence": pl.String,
    "recommended_action": pl.String, "raised_severity": pl.String, "now_flight_id": pl.String,
    "evidence_now": pl.String, "closed_reason": pl.String, "follows": pl.String, "units_in_90_days": pl.Int64,
}  # fmt: skip


def raise_alerts(
    features: pl.DataFrame, health_parameters: pl.DataFrame, maintenance: pl.DataFrame, limits: Limits | None = None
) -> pl.DataFrame:
    """Alerts of a fleet, one row a case.

    Parameters
    ----------
    features : DataFrame
        `features.features(...)` with the witness columns: door and sensor faults are judged from those.
    health_parameters : DataFrame
        Long form; fills in health where `features` carries none.
    maintenance : DataFrame
        operator, tail, pack, done_on, component, action, finding. Work on a component ends its cases, and an inspection
        that found nothing answers them.

    Returns
    -------
    DataFrame
        The columns of the catalog's `alerts`. A case keeps its `alert_id` however much later data arrives.
    """
    grid = Grid.cut(with_health(features, health_parameters))
    cases = find_cases(grid, maintenance, limits) if grid.rows.height else []
    return as_alerts(grid, maintenance, cases, limits or Limits())


def as_alerts(grid: Grid, maintenance: pl.DataFrame, cases: list[Case], limits: Limits) -> pl.DataFrame:
    """Cases, each ended where work ends it and answered by what was found, as rows of the catalog."""
    cases = answer_findings(grid, maintenance, end_with_the_unit(grid, maintenance, cases), limits)
    came = units_that_came(maintenance, (DIAGNOSES[case.diagnosis].component for case in cases))
    rows = [alert_row(grid, came, case, DIAGNOSES[case.diagnosis]) for case in cases]
    alerts = pl.DataFrame(rows, schema=SCHEMA, orient="row").unique("alert_id", keep="first", maintain_order=True)
    return alerts.sort("raised_at", "tail", "pack", "alert_id")


@dataclass(frozen=True, slots=True)
class Disturbances:
    """Cases of doors and sensors, and where they leave wear in doubt. Flags are (units, flights) bool."""

    doors: list[Case]
    sensors: list[Case]
    unclear: Array
    feigned: Array
    sick: Array


def find_cases(grid: Grid, maintenance: pl.DataFrame, limits: Limits | None = None) -> list[Case]:
    """All cases of a fleet; nothing looks ahead of the flight on which a case is raised.

    Doors are judged first, then sensors, then wear: what a faulty door or sensor explains is not called wear.
    """
    limits = limits or Limits()
    found = find_disturbances(grid, maintenance, limits)
    return found.doors + found.sensors + wear_cases(grid, maintenance, limits, found)


def find_disturbances(grid: Grid, maintenance: pl.DataFrame, limits: Limits) -> Disturbances:
    """What doors and sensors do."""
    doors = door_cases(grid, maintenance, limits)
    door_on = occupied(grid.shape, doors)
    jammed = occupied(grid.shape, [c for c in doors if c.facts["kind"] == "jam"])
    sensors = sensor_cases(grid, maintenance, limits, door_on, jammed)
    biased = [c for c in sensors if c.facts.get("biased")]
    # outlets that differ leave no doubt once it is known whose sensor or door is why
    named = door_on | occupied(grid.shape, [c for c in biased if c.facts["sensor"] == "hx_out_k"])
    unclear = door_on | (outlet_doubtful(grid) & ~named & ~grid.across(named))
    feigned = occupied(grid.shape, [c for c in biased if feigns_wear(c)])
    return Disturbances(doors, sensors, unclear, feigned, unclear | occupied(grid.shape, biased))


def wear_cases(grid: Grid, maintenance: pl.DataFrame, limits: Limits, found: Disturbances) -> list[Case]:
    """Wear, where no door and no sensor explains it."""
    compressors = cc_cases(grid, maintenance, limits, occupied(grid.shape, found.sensors))
    low = low_margin_cases(grid, maintenance, limits, found.unclear | found.feigned)
    exchangers = hx_cases(grid, maintenance, limits, found.sick, occupied(grid.shape, low))
    return exchangers + low + compressors


def with_health(features: pl.DataFrame, health_parameters: pl.DataFrame) -> pl.DataFrame:
    """Features with the health columns that the rules need, taken from the long form where absent."""
    wide = features
    for name in ("hx_fouling", "cc_efficiency_loss", "cc_effective_diameter_m"):
        if name not in wide.columns and health_parameters.height:
            one = health_parameters.filter(pl.col("parameter") == name).unique(LEG, keep="last")
            both = pl.col("value").alias(name), pl.col("sd").alias(f"{name}_sd")
            wide = wide.join(one.select(*LEG, *both), on=LEG, how="left", validate="m:1")
    return wide


def alert_row(grid: Grid, came: Came, case: Case, said: Diagnosis) -> tuple[Any, ...]:
    """A case as a row of `SCHEMA`."""
    operator, tail, pack = grid.units.row(case.unit)
    flown = grid.count(case.unit)
    closed = case.closed if case.closed is not None and case.closed < flown else None
    now = (flown if closed is None else closed) - 1
    since = str(grid.at("flight_id", case.unit, int(case.facts["since"])))
    then, latest = (said.facts(grid, case, flight) for flight in (case.raised, now))
    units = _count_units(grid, came, case, said)
    return (
        case_id(grid, case), operator, tail, pack, case.component, case.diagnosis,
        grid.at("flight_id", case.unit, case.raised), grid.at("departed_at", case.unit, case.raised),
        case.ended_at if closed is None else grid.at("departed_at", case.unit, closed),
        said.severity(latest), said.evidence(then, since).text(), _action_of(said, units) + said.addendum(then),
        said.severity(then), grid.at("flight_id", case.unit, now), said.evidence(latest, since).text(),
        case.ended_reason if closed is None else case.closed_reason, case.facts.get("follows"), units,
    )  # fmt: skip


def units_that_came(maintenance: pl.DataFrame, components: Iterable[str]) -> Came:
    """The replacements of some components."""
    found: Came = {}
    for component in set(components):
        own = found.setdefault(component, {})
        for *pack, moment in select_entries(maintenance, (component,), NEW_UNIT).select(*PACK, "counts_from").rows():
            own.setdefault(tuple(pack), []).append(moment)
    return found


def _count_units(grid: Grid, came: Came, case: Case, said: Diagnosis) -> int | None:
    """Units that this position has had in the `REPEAT_DAYS` before the case was raised, its own included.

    None where the log's component is no single unit: sensors and what drives a door.
    """
    if said.ended_by == REPAIR:
        return None
    raised = grid.at("departed_at", case.unit, case.raised)
    assert isinstance(raised, datetime)
    moments = came[said.component].get(grid.units.row(case.unit), [])
    return 1 + sum(raised - timedelta(REPEAT_DAYS) < moment <= raised for moment in moments)


def _action_of(said: Diagnosis, units: int | None) -> str:
    """What to do; of a position that has had too many units, find out why first."""
    if units is None or units < REPEAT_UNITS:
        return said.action
    then = f"{said.action[0].lower()}{said.action[1:]}"
    return phrases.UPSTREAM.format(units=units, days=REPEAT_DAYS) + phrases.THEN + then
