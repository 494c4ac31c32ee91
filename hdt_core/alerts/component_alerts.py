"""Features and alerts of declared components: one loss, its trend, and whether it exceeds the limit to plan for.

The pack's parts have rules of their own in `wear`, `sensor_faults` and `door_faults`.
"""

import numpy as np
import polars as pl

from hdt_core.alerts import phrases
from hdt_core.alerts.alerts import SCHEMA, alert_rows
from hdt_core.alerts.case_closure import close_after_work
from hdt_core.alerts.cases import Case, Limits, runs
from hdt_core.alerts.diagnoses import Diagnosis
from hdt_core.alerts.evidence import (
    NEUTRAL,
    SUPPORTS,
    Corroboration,
    Evidence,
    Facts,
    graded,
    loss_finding,
    trend,
    within,
)
from hdt_core.alerts.grid import Grid
from hdt_core.alerts.wear import odds_above
from hdt_core.components import Component
from hdt_core.health.detection import persistent
from hdt_core.health.features import features

KEYS = ["operator", "tail", "flight_id", "pack", "departed_at", "flight_index", "flights_seen_of_unit"]
TRENDS = ("sd", "status", "slope_10_per_flight", "slope_30_per_flight", "slope_100_per_flight", "jump_10", "step_3")
"""Columns of the loss beside its value, each prefixed with the loss's name."""
HIGH_SEVERITY_SHARE = 0.8
"""Loss from which severity is high, as a share of the loss at which the component fails. [-]"""


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


def diagnosis_of(component: Component, limits: Limits) -> Diagnosis:
    """Return the diagnosis of a worn component, with the texts of its declaration."""
    return Diagnosis(
        code=component.diagnosis,
        component=component.code,
        name=f"{component.name} worn",
        action=component.action,
        ended_by=component.ended_by,
        severity=lambda facts: "high" if facts["loss"] > HIGH_SEVERITY_SHARE * component.limit.mean else "medium",
        evidence=lambda facts, since: _evidence(component, limits, facts, since),
        features=("loss", "loss_sd", "loss_slope_30_per_flight", "loss_step_3"),
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
    grid, diagnosis = Grid.from_frame(own), diagnosis_of(component, limits)
    cases = _wear_cases(grid, maintenance, component, limits)
    cases = close_after_work(grid, maintenance, cases, [diagnosis])
    return alert_rows(grid, maintenance, cases, {diagnosis.code: diagnosis})


def _wear_cases(grid: Grid, maintenance: pl.DataFrame, component: Component, limits: Limits) -> list[Case]:
    """Find losses above their limit with enough probability on most recent flights, until long below it."""
    restart = grid.worked_on(maintenance, (component.code,), component.ended_by)
    loss, sd = grid.values("loss"), grid.values("loss_sd")
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


def _evidence(component: Component, limits: Limits, facts: Facts, since: str) -> Evidence:
    """Return the evidence of wear, with the texts of the component's declaration."""
    loss, sd, slope = facts["loss"], facts["loss_sd"], facts["loss_slope_30_per_flight"]
    lost, name = component.lost, component.loss
    finding = loss_finding(phrases.UNIT_LOST, loss, sd, component.warn_loss, since, lost=lost, name=name)
    fails = phrases.UNIT_FAILS.format(loss=within(component.limit.mean, component.limit.unit_sd))
    near = Corroboration(SUPPORTS if loss > HIGH_SEVERITY_SHARE * component.limit.mean else NEUTRAL, fails)
    sudden = graded(facts["loss_step_3"], (limits.clog, NEUTRAL, phrases.UNIT_STEP))
    return Evidence("; ".join([finding, *trend(slope)]), (near, *sudden), component.otherwise, component.waiting)
