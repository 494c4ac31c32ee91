"""Which alerts there would have been with a limit higher or lower: the same rule over the same features.

Faults of sensors are not among them: a sensor is named by a probability, and no one limit decides.
"""

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace

import polars as pl

from hdt_core.alerts.alerts import Disturbances, as_alerts, find_disturbances, wear_cases, with_health
from hdt_core.alerts.cases import Limits
from hdt_core.alerts.door_faults import door_cases
from hdt_core.alerts.grid import Grid

VARIED = {
    "HX_FOULING": ("fouling", (0.10, 0.125, 0.15, 0.20, 0.25)),
    "HX_SUDDEN_CLOG": ("clog", (0.07, 0.10, 0.15, 0.20)),
    "HX_LOW_MARGIN": ("passage", (0.70, 0.80, 0.90, 0.95, 0.98)),
    "CC_DEGRADED": ("compressor", (0.03, 0.04, 0.05, 0.07)),
    "RAM_DOOR_FAULT": ("peg_k", (0.9, 1.3, 1.8, 2.5)),
}
"""Of each diagnosis the limit (of `Limits`) that decides, and what it is set to; the one in service is among them."""


@dataclass(frozen=True, slots=True)
class Trial:
    """All alerts of a fleet with one limit set otherwise."""

    diagnosis: str
    limit: str
    value: float
    in_service: bool
    alerts: pl.DataFrame


def trials(
    features: pl.DataFrame, health_parameters: pl.DataFrame, maintenance: pl.DataFrame, limits: Limits | None = None
) -> Iterator[Trial]:
    """Alerts of a fleet at other limits, one at a time; arguments as of `alerts.raise_alerts`.

    What doors and sensors do is judged once and held fixed while a limit of wear moves.
    """
    limits = limits or Limits()
    judged = [_judged(own, health_parameters, maintenance, limits) for own in features.partition_by("operator", "tail")]
    for diagnosis, (name, values) in VARIED.items():
        for value in values:
            moved = replace(limits, **{name: value})
            raised = [_raised(aircraft, diagnosis, moved) for aircraft in judged]
            if raised:
                yield Trial(diagnosis, name, value, value == getattr(limits, name), pl.concat(raised))


@dataclass(frozen=True, slots=True)
class _Aircraft:
    """One aircraft, as a night judges it: its features, its log, what its doors and sensors do."""

    grid: Grid
    maintenance: pl.DataFrame
    found: Disturbances


def _judged(
    features: pl.DataFrame, health_parameters: pl.DataFrame, maintenance: pl.DataFrame, limits: Limits
) -> _Aircraft:
    own = {"operator": features["operator"][0], "tail": features["tail"][0]}
    log = maintenance.filter(**own) if maintenance.height else maintenance
    health = health_parameters.filter(**own) if health_parameters.height else health_parameters
    grid = Grid.cut(with_health(features, health))
    return _Aircraft(grid, log, find_disturbances(grid, log, limits))


def _raised(aircraft: _Aircraft, diagnosis: str, limits: Limits) -> pl.DataFrame:
    """Alerts of one aircraft with the limit of a diagnosis moved."""
    grid, log, found = aircraft.grid, aircraft.maintenance, aircraft.found
    if diagnosis == "RAM_DOOR_FAULT":
        cases = door_cases(grid, log, limits)
    else:
        # copies: where a case ends is written into it
        cases = [*map(copy, found.doors + found.sensors), *wear_cases(grid, log, limits, found)]
    return as_alerts(grid, log, cases, limits)
