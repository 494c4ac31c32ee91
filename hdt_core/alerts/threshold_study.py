"""Alerts of a fleet with one limit higher or lower, by the same rules over the same features.

Sensor faults are left out: a probability isolates a sensor, and no single limit decides.
"""

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import polars as pl

from hdt_core.alerts.alerts import as_alerts, find_disturbances, wear_cases, with_health
from hdt_core.alerts.cases import Limits
from hdt_core.alerts.door_faults import door_cases
from hdt_core.alerts.grid import Grid

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


def trials(
    features: pl.DataFrame, health_parameters: pl.DataFrame, maintenance: pl.DataFrame, limits: Limits | None = None
) -> Iterator[Trial]:
    """Yield the alerts of a fleet at other limits, one at a time; arguments as of `alerts.raise_alerts`.

    Door and sensor cases are found once and stay fixed while a limit of wear changes.
    """
    if features.is_empty():
        return
    limits = limits or Limits()
    grid = Grid.from_frame(with_health(features, health_parameters))
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
