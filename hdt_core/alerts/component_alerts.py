"""Alerts of declared components: one loss, its trend, and whether it exceeds the limit to plan for."""

from dataclasses import dataclass

import numpy as np
import polars as pl

from hdt_core.alerts.alerts import alert_rows
from hdt_core.alerts.cases import Case, Grid, Limits, runs
from hdt_core.alerts.diagnosis import Diagnosis
from hdt_core.alerts.endings import close_after_work
from hdt_core.alerts.evidence import NEUTRAL, SUPPORTS, Corroboration, Evidence, graded, loss_finding, trend, within
from hdt_core.alerts.facts import FeatureFacts
from hdt_core.alerts.text import Column, Phrase, Text
from hdt_core.alerts.wear import odds_above
from hdt_core.components import Component
from hdt_core.health.detection import persistent
from hdt_core.health.features import features
from hdt_core.tables.alerts import FeaturesAlerts
from hdt_core.tables.twin import FeaturesComponents

UNIT_LOST = Phrase(
    "{lost}{name} {loss}, {sigma} times its uncertainty; above {limit} % since {since}, and with probability {odds}"
)
UNIT_FAILS = Phrase("it fails at about {loss}")
UNIT_STEP = Phrase("{points} points came within three flights: a sudden event")
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
    rows = features(health.filter(own), residuals.filter(own), legs.filter(own), maintenance, health=[component.loss])
    named = rows.rename(lambda name: name.replace(component.loss, "loss")).with_columns(
        component=pl.lit(component.code)
    )
    return FeaturesComponents.conform(FeaturesComponents.derive(named))


@dataclass(frozen=True, slots=True, kw_only=True)
class LossFacts(FeatureFacts):
    """Of a worn part that a package declares."""

    loss: float
    loss_sd: float
    loss_slope_30_per_flight: float
    loss_step_3: float


def declared_loss(component: Component, limits: Limits, facts: LossFacts, since: str) -> Evidence:
    """Return the evidence of a declared component's wear, with the texts of the component's declaration."""
    loss = facts.loss
    lost = Text.whole(component.lost)
    name = Column(component.loss)
    warn_loss = component.warn_loss
    finding = loss_finding(UNIT_LOST, loss, facts.loss_sd, warn_loss, since, lost=lost, name=name)
    fails = Text(UNIT_FAILS, loss=within(component.limit.mean, component.limit.unit_sd))
    near = Corroboration(SUPPORTS if loss > HIGH_SEVERITY_SHARE * component.limit.mean else NEUTRAL, fails)
    sudden = graded(facts.loss_step_3, (limits.clog, NEUTRAL, UNIT_STEP))
    findings = (finding, *trend(facts.loss_slope_30_per_flight))
    return Evidence(findings, (near, *sudden), component.otherwise, component.waiting)


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
        return FeaturesAlerts.create_empty()
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
