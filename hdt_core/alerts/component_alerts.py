"""Features and alerts of declared components: one loss, its trend, and whether it is past what a planner wants to know.

The pack's parts have rules of their own in `wear`, `low_margin`, `sensors` and `doors`.
"""

import math

import numpy as np
import polars as pl

from hdt_core.alerts import phrases
from hdt_core.alerts.alerts import SCHEMA, alert_row, units_that_came
from hdt_core.alerts.case_closure import end_with_the_unit
from hdt_core.alerts.cases import Case, Limits, spells
from hdt_core.alerts.diagnoses import Diagnosis
from hdt_core.alerts.evidence import NEUTRAL, SUPPORTS, Corroboration, Evidence
from hdt_core.alerts.grid import Grid
from hdt_core.alerts.wear import odds_above
from hdt_core.alerts.wording import Facts, chance_above, within
from hdt_core.components import Component
from hdt_core.health.detection import persistent
from hdt_core.health.features import features

KEYS = ["operator", "tail", "flight_id", "pack", "departed_at", "flight_index", "flights_seen_of_unit"]
TRENDS = ("sd", "status", "slope_10_per_flight", "slope_30_per_flight", "slope_100_per_flight", "jump_10", "step_3")
"""What is told of the loss beside its value, each with the loss's name before it."""
NEAR = 0.8
"""Share of the loss at which the component fails from which its alert is of high severity. [-]"""
STEP = 0.1
"""Loss gained within three flights, beyond the trend, that wear does not make: as for the exchanger. [-]"""


def component_features(
    health: pl.DataFrame, residuals: pl.DataFrame, legs: pl.DataFrame, maintenance: pl.DataFrame, component: Component
) -> pl.DataFrame:
    """One row a flight and pack: the loss under the name `loss` with its trends, and the residual of the twin.

    Parameters
    ----------
    health, residuals, legs : DataFrame
        Of all components; those of this one are taken.
    """
    own = pl.col("component") == component.code
    seen = features(health.filter(own), residuals.filter(own), legs.filter(own), maintenance, health=[component.loss])
    trends = [pl.col(f"{component.loss}_{t}").alias(f"loss_{t}") for t in TRENDS if f"{component.loss}_{t}" in seen]
    told = pl.col(component.loss).alias("loss") if component.loss in seen.columns else pl.lit(None).alias("loss")
    return seen.select(*KEYS, pl.lit(component.code).alias("component"), told, *trends)


def diagnosis_of(component: Component) -> Diagnosis:
    """The alert that calls a component worn: its words follow from the declaration."""

    def evidence(facts: Facts, since: str) -> Evidence:
        return _evidence(component, facts, since)

    return Diagnosis(
        code=component.diagnosis,
        component=component.code,
        name=f"{component.name} worn",
        action=component.action,
        ended_by=component.ended_by,
        severity=lambda facts: "high" if facts["loss"] > NEAR * component.limit.mean else "medium",
        evidence=evidence,
        measured=("loss", "loss_sd", "loss_slope_30_per_flight", "loss_step_3"),
    )


def raise_component_alerts(
    described: pl.DataFrame, maintenance: pl.DataFrame, component: Component, limits: Limits | None = None
) -> pl.DataFrame:
    """Alerts of one component, one row a case, in the columns of the catalog's `alerts`.

    Parameters
    ----------
    described : DataFrame
        Of `component_features`.
    maintenance : DataFrame
        Work on the component ends its cases.
    """
    own = described.filter(pl.col("component") == component.code)
    if own.is_empty():
        return pl.DataFrame(schema=SCHEMA)
    grid, said = Grid.cut(own), diagnosis_of(component)
    cases = end_with_the_unit(grid, maintenance, _worn(grid, maintenance, component, limits or Limits()), [said])
    came = units_that_came(maintenance, (said.component,))
    rows = [alert_row(grid, came, case, said) for case in cases]
    return pl.DataFrame(rows, schema=SCHEMA, orient="row").sort("raised_at", "tail", "pack", "alert_id")


def _worn(grid: Grid, maintenance: pl.DataFrame, component: Component, limits: Limits) -> list[Case]:
    """Loss above its limit with enough probability on three of four flights, until it has long been below."""
    ended = grid.worked_on(maintenance, (component.code,), component.ended_by)
    loss, sd = grid.values("loss"), grid.values("loss_sd")
    sure = grid.as_observed(odds_above(loss, sd, component.warn_loss) > limits.fouling_odds, "loss", ended)
    keep = np.nan_to_num(loss) > 0.75 * component.warn_loss
    on = persistent(sure, 3, 4, 15, keep=keep, ended=ended)
    return [
        Case(unit, component.code, component.diagnosis, first, end, {"since": _began(sure[unit], first)})
        for unit, first, end in spells(on, ended)
    ]


def _began(sure: np.ndarray, first: int) -> int:
    """First of the last four flights up to `first` on which it was so."""
    recent = np.flatnonzero(sure[max(first - 3, 0) : first + 1])
    return int(max(first - 3, 0) + recent[0]) if recent.size else first


def _evidence(component: Component, facts: Facts, since: str) -> Evidence:
    loss, sd, slope = facts["loss"], facts["loss_sd"], facts["loss_slope_30_per_flight"]
    moved = [
        phrases.UNIT_LOST.format(
            lost=component.lost,
            name=component.loss,
            loss=within(loss, sd),
            sigma=f"{loss / max(sd, 1e-6):.0f}",
            limit=f"{100 * component.warn_loss:.0f}",
            since=since,
            odds=chance_above(loss, component.warn_loss, sd),
        )
    ]
    if slope > 1e-5:
        moved.append(phrases.TREND.format(points=f"{1000 * slope:.1f}"))
    fails = phrases.UNIT_FAILS.format(loss=within(component.limit.mean, component.limit.unit_sd))
    told = [Corroboration(SUPPORTS if loss > NEAR * component.limit.mean else NEUTRAL, fails)]
    if not math.isnan(facts["loss_step_3"]) and facts["loss_step_3"] > STEP:
        told.append(Corroboration(NEUTRAL, phrases.UNIT_STEP.format(points=f"{100 * facts['loss_step_3']:.0f}")))
    return Evidence("; ".join(moved), tuple(told), component.otherwise, component.waiting)
