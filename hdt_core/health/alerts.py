"""Alerts: all cases of a fleet as rows of the catalog."""

import hashlib
from typing import Any

import polars as pl

from hdt_core.health.doors import door_cases
from hdt_core.health.episodes import Case, Limits, occupied
from hdt_core.health.grid import Grid
from hdt_core.health.sensors import outlet_doubtful, sensor_cases
from hdt_core.health.wear import cc_cases, hx_cases
from hdt_core.health.wording import action, evidence, severity

KEY = ["operator", "tail", "flight_id", "pack"]
SCHEMA: dict[str, Any] = {
    "alert_id": pl.String, "operator": pl.String, "tail": pl.String, "pack": pl.Int32, "component": pl.String,
    "diagnosis": pl.String, "raised_flight_id": pl.String, "raised_at": pl.Datetime("us", "UTC"),
    "closed_at": pl.Datetime("us", "UTC"), "severity": pl.String, "evidence": pl.String,
    "recommended_action": pl.String,
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
        operator, tail, pack, done_on, component, action. Work on a component closes its cases.

    Returns
    -------
    DataFrame
        The columns of the catalog's `alerts`. A case keeps its `alert_id` however much later data arrives.
    """
    grid = Grid.cut(_with_health(features, health_parameters))
    rows = [_row(grid, case) for case in find_cases(grid, maintenance, limits)] if grid.rows.height else []
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
    biased = occupied(grid.shape, [c for c in sensors if c.facts.get("biased")])
    sick = door_on | biased | outlet_doubtful(grid)
    compressors = cc_cases(grid, maintenance, limits, occupied(grid.shape, sensors))
    return doors + sensors + hx_cases(grid, maintenance, limits, sick) + compressors


def _with_health(features: pl.DataFrame, health_parameters: pl.DataFrame) -> pl.DataFrame:
    """Features with the health columns that the rules need, taken from the long form where absent."""
    wide = features
    for name in ("hx_fouling", "cc_efficiency_loss", "cc_effective_diameter_m"):
        if name not in wide.columns and health_parameters.height:
            one = health_parameters.filter(pl.col("parameter") == name).unique(KEY, keep="last")
            both = pl.col("value").alias(name), pl.col("sd").alias(f"{name}_sd")
            wide = wide.join(one.select(*KEY, *both), on=KEY, how="left")
    return wide


def _row(grid: Grid, case: Case) -> tuple[Any, ...]:
    operator, tail, pack = grid.units.row(case.unit)
    flight_id = str(grid.at("flight_id", case.unit, case.raised))
    sensor = str(case.facts.get("sensor", ""))
    name = "|".join((tail, str(pack), case.component, case.diagnosis, flight_id, sensor))
    flown = int((grid.unit == case.unit).sum())
    closed = case.closed is not None and case.closed < flown
    return (
        hashlib.sha256(name.encode()).hexdigest()[:16], operator, tail, pack, case.component, case.diagnosis, flight_id,
        grid.at("departed_at", case.unit, case.raised),
        grid.at("departed_at", case.unit, case.closed) if closed and case.closed is not None else None,
        severity(case), evidence(grid, case), action(case),
    )  # fmt: skip
