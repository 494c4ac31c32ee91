"""Diagnosis of an alert: its facts, texts, action, and the work that closes its cases."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
import polars as pl

from hdt_core.alerts.cases import Case, Grid, Limits
from hdt_core.alerts.disturbances import Disturbances
from hdt_core.alerts.evidence import Evidence
from hdt_core.alerts.facts import Facts
from hdt_core.alerts.text import Text

F = TypeVar("F", bound=Facts)
Rule = Callable[[Grid, pl.DataFrame, Limits, Disturbances], list[Case]]
"""Finds cases on a grid, given maintenance, limits, and what doors and sensors disturb."""


@dataclass(frozen=True, slots=True)
class Diagnosis(Generic[F]):
    """One kind of case: its texts, its action and what ends it.

    Attributes
    ----------
    code, component, name : str
        As in the catalog; the component as in the log of work; the name in plain words.
    action : str
        What to do, with its ATA task.
    ended_by : tuple of str
        Actions on the component that end the case, because another or a repaired part is fitted.
    record : type
        Facts that severity and evidence rest on.
    severity : callable
        `low`, `medium` or `high` by the facts of a moment.
    evidence : callable
        Evidence by the facts of a moment and the flight since which the finding holds.
    addendum : callable, optional
        Texts that the facts add to the action.
    ended_by_sound : bool
        Whether an inspection of the component without a finding ends the case.
    rule : callable, optional
        Finds its cases, where no other module does.
    loss : str, optional
        Feature of the loss that it rests on.
    limit, limit_values : str, tuple of float
        The limit (of `Limits`) that decides, and the values at which it is tried; that in service is among them.
    is_wear : bool
        Whether it is wear alone: the work of least expected cost is its action, and after an inspection without a
        finding it is raised again only for a growth beyond its limit.
    """

    code: str
    component: str
    name: str
    action: str
    ended_by: tuple[str, ...]
    record: type[F]
    severity: Callable[[F], str]
    evidence: Callable[[F, str], Evidence]
    addendum: Callable[[F], tuple[Text, ...]] = lambda facts: ()
    ended_by_sound: bool = True
    rule: Rule | None = None
    loss: str | None = None
    limit: str | None = None
    limit_values: tuple[float, ...] = ()
    is_wear: bool = False

    def facts(self, grid: Grid, case: Case, flight: int) -> F:
        """Return the facts after a flight: those the case was raised with, and the latest features."""
        own = case.facts | case.facts_at(flight)
        return self.record.collect(own, lambda name: _latest(grid, name, case, flight))


def _latest(grid: Grid, name: str, case: Case, flight: int) -> float:
    """Return the last value of a feature from the flight that raised the case to `flight`."""
    values = grid.track(name, case.unit)[case.raised_flight : flight + 1]
    values = values[np.isfinite(values)]
    return float(values[-1]) if values.size else np.nan
