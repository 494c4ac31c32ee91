"""Alerts: all cases of a fleet as rows of the catalog."""

import hashlib
from collections.abc import Iterable
from datetime import datetime
from typing import Any

import numpy as np
import polars as pl

from hdt_core.health.diagnoses import DIAGNOSES, Diagnosis
from hdt_core.health.doors import door_cases
from hdt_core.health.episodes import Case, Limits, occupied
from hdt_core.health.grid import Grid
from hdt_core.health.low_margin import low_margin_cases
from hdt_core.health.sensors import feigns_wear, outlet_doubtful, sensor_cases
from hdt_core.health.wear import cc_cases, hx_cases
from hdt_core.records.unit_index import PACK, select_entries

KEY = ["operator", "tail", "flight_id", "pack"]
SCHEMA: dict[str, Any] = {
    "alert_id": pl.String, "operator": pl.String, "tail": pl.String, "pack": pl.Int32, "component": pl.String,
    "diagnosis": pl.String, "raised_flight_id": pl.String, "raised_at": pl.Datetime("us", "UTC"),
    "closed_at": pl.Datetime("us", "UTC"), "severity": pl.String, "evidence": pl.String,
    "recommended_action": pl.String, "raised_severity": pl.String, "now_flight_id": pl.String,
    "evidence_now": pl.String,
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
        operator, tail, pack, done_on, component, action. Work on a component ends its cases.

    Returns
    -------
    DataFrame
        The columns of the catalog's `alerts`. A case keeps its `alert_id` however much later data arrives.
    """
    grid = Grid.cut(_with_health(features, health_parameters))
    cases = end_with_the_unit(grid, maintenance, find_cases(grid, maintenance, limits)) if grid.rows.height else []
    rows = [alert_row(grid, case, DIAGNOSES[case.diagnosis]) for case in cases]
    alerts = pl.DataFrame(rows, schema=SCHEMA, orient="row").unique("alert_id", keep="first", maintain_order=True)
    return alerts.sort("raised_at", "tail", "pack", "alert_id")


def find_cases(grid: Grid, maintenance: pl.DataFrame, limits: Limits | None = None) -> list[Case]:
    """All cases of a fleet; nothing looks ahead of the flight on which a case is raised.

    Doors are judged first, then sensors, then wear: what a faulty door or sensor explains is not called wear.
    """
    limits = limits or Limits()
    doors = door_cases(grid, maintenance, limits)
    door_on = occupied(grid.shape, doors)
    jammed = occupied(grid.shape, [c for c in doors if c.facts["kind"] == "jam"])
    sensors = sensor_cases(grid, maintenance, limits, door_on, jammed)
    biased = [c for c in sensors if c.facts.get("biased")]
    # outlets that differ leave no doubt once it is known whose sensor or door is why
    named = door_on | occupied(grid.shape, [c for c in biased if c.facts["sensor"] == "hx_out_k"])
    unclear = door_on | (outlet_doubtful(grid) & ~named & ~grid.across(named))
    compressors = cc_cases(grid, maintenance, limits, occupied(grid.shape, sensors))
    feigned = occupied(grid.shape, [c for c in biased if feigns_wear(c)])
    low = low_margin_cases(grid, maintenance, limits, unclear | feigned)
    sick = unclear | occupied(grid.shape, biased)
    exchangers = hx_cases(grid, maintenance, limits, sick, occupied(grid.shape, low))
    return doors + sensors + exchangers + low + compressors


def end_with_the_unit(
    grid: Grid, maintenance: pl.DataFrame, cases: list[Case], diagnoses: Iterable[Diagnosis] = tuple(DIAGNOSES.values())
) -> list[Case]:
    """Close every case where work on its component ends it, whatever is seen of the pack from then on.

    The case ends on the first flight that counts as flown after the work (`records.unit_index`), however late the entry
    came; where none has followed yet, at the moment from which the entry counts.
    """
    for said in diagnoses:
        own = [case for case in cases if case.diagnosis == said.code]
        if not own:
            continue
        ended = grid.worked_on(maintenance, (said.component,), said.ended_by)
        waiting = _unflown(grid, maintenance, said.component, said.ended_by)
        for case in own:
            later = case.raised + 1 + np.flatnonzero(ended[case.unit, case.raised + 1 :])
            if later.size and (case.closed is None or case.closed > later[0]):
                case.closed = int(later[0])
            case.ended_at = waiting.get(case.unit)
    return cases


def _unflown(grid: Grid, maintenance: pl.DataFrame, component: str, actions: tuple[str, ...]) -> dict[int, datetime]:
    """Of units worked on since their last flight, the moment from which the first such entry counts."""
    last = (
        grid.rows.select(*PACK, "departed_at", pl.Series("unit", grid.unit))
        .group_by(*PACK, "unit")
        .agg(pl.col("departed_at").max())
    )
    entries = select_entries(maintenance, (component,), actions).join(last, on=PACK)
    later = (
        entries.filter(pl.col("counts_from") > pl.col("departed_at")).group_by("unit").agg(pl.col("counts_from").min())
    )
    return dict(later.select("unit", "counts_from").rows())


def _with_health(features: pl.DataFrame, health_parameters: pl.DataFrame) -> pl.DataFrame:
    """Features with the health columns that the rules need, taken from the long form where absent."""
    wide = features
    for name in ("hx_fouling", "cc_efficiency_loss", "cc_effective_diameter_m"):
        if name not in wide.columns and health_parameters.height:
            one = health_parameters.filter(pl.col("parameter") == name).unique(KEY, keep="last")
            both = pl.col("value").alias(name), pl.col("sd").alias(f"{name}_sd")
            wide = wide.join(one.select(*KEY, *both), on=KEY, how="left")
    return wide


def alert_row(grid: Grid, case: Case, said: Diagnosis) -> tuple[Any, ...]:
    """A case as a row of `SCHEMA`."""
    operator, tail, pack = grid.units.row(case.unit)
    flight_id = str(grid.at("flight_id", case.unit, case.raised))
    name = "|".join((tail, str(pack), case.component, case.diagnosis, flight_id, str(case.facts.get("sensor", ""))))
    flown = int((grid.unit == case.unit).sum())
    closed = case.closed if case.closed is not None and case.closed < flown else None
    now = (flown if closed is None else closed) - 1
    since = str(grid.at("flight_id", case.unit, int(case.facts["since"])))
    then, latest = (said.facts(grid, case, flight) for flight in (case.raised, now))
    return (
        hashlib.sha256(name.encode()).hexdigest()[:16], operator, tail, pack, case.component, case.diagnosis, flight_id,
        grid.at("departed_at", case.unit, case.raised),
        case.ended_at if closed is None else grid.at("departed_at", case.unit, closed),
        said.severity(latest), said.evidence(then, since).text(), said.action + said.addendum(then),
        said.severity(then), grid.at("flight_id", case.unit, now), said.evidence(latest, since).text(),
    )  # fmt: skip
