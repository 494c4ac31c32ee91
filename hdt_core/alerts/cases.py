"""A case: a belief about one pack from its first flight to its last, and the limits at which belief becomes a case."""

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import numpy as np

from hdt_core.alerts.grid import Grid
from hdt_core.components.exchanger import HX
from hdt_core.health.detection import Array

REPAIR = ("REPLACED", "CLEANED", "ADJUSTED")
"""Actions after which a part is not the part it was."""
DIAMETER_SD = 0.022
"""Flight-to-flight scatter of the effective diameter of a sound compressor, relative. [-]"""
FAILS_AT = HX.limit.mean
"""Loss of conductance at which packs ran out of ram door in the first fleets seen; used where the margin is unknown."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Where belief turns into a case. Losses and openings are fractions.

    Attributes
    ----------
    fouling : float
        Loss of conductance that a planner wants to know of, once it is exceeded with probability `fouling_odds`: about
        six packs in 1,000 flights come this far, and two of them may be called too early.
    fouling_soon, soon_odds, soon_flights : float
        Where the margin is not known, a smaller loss, exceeded with probability `soon_odds`, is told of when its trend
        leads to `FAILS_AT` within so many flights: about a month of warning, which a shop visit takes.
    clog : float
        Loss gained within three flights, beyond the trend, that calls for a look at the core: nine sigma of the
        difference, and three times the dust that one bad station leaves.
    ram_flow : float
        Loss of ram flow gained with it, where a ram outlet probe tells: less, and it is a film, not a blockage.
    passage : float
        Chance of the message within 300 flights, by physics alone, that calls for a plan though the loss is small.
    compressor : float
        Efficiency loss worth a case.
    lost : float
        Share of empty readings; a sound sensor loses 1 %.
    still_span : float
        A door that moves less from climb to descent does not follow: seven sigma of its position sensor.
    peg_k : float
        Outlet above its target while the door rests, not open, at its widest: four sigma of a sound flight.
    """

    fouling: float = 0.15
    fouling_odds: float = 0.7
    fouling_soon: float = 0.09
    soon_odds: float = 0.8
    soon_flights: float = 100.0
    clog: float = 0.1
    ram_flow: float = 0.04
    passage: float = 0.9
    compressor: float = 0.05
    lost: float = 0.2
    still_span: float = 0.035
    peg_k: float = 1.3


@dataclass(slots=True)
class Case:
    """One belief about a pack; `raised` and `closed` are the pack's flights, `closed` None while it holds.

    `facts` are those it was raised with; `at` gives, after any flight, what only its own rule can measure; `ended_at`
    is when work ended a case that is open after the pack's last flight. `closed_reason` and `ended_reason` say why:
    `recovered` (what was believed is no longer seen), `renewed` (another or a repaired part flies), `found_clean`.
    """

    unit: int
    component: str
    diagnosis: str
    raised: int
    closed: int | None
    facts: dict[str, Any] = field(default_factory=dict)
    at: Callable[[int], dict[str, Any]] = lambda flight: {}
    ended_at: datetime | None = None
    closed_reason: str = "recovered"
    ended_reason: str | None = None


def case_id(grid: Grid, case: Case) -> str:
    """Name of a case in the catalog: it stays however much later data arrives."""
    _, tail, pack = grid.units.row(case.unit)
    flight_id = str(grid.at("flight_id", case.unit, case.raised))
    name = "|".join((tail, str(pack), case.component, case.diagnosis, flight_id, str(case.facts.get("sensor", ""))))
    return hashlib.sha256(name.encode()).hexdigest()[:16]


def spells(active: Array, ended: Array) -> Iterator[tuple[int, int, int | None]]:
    """Runs of `active`, cut where `ended`: unit, first flight, and the flight after the last (None while it holds).

    Examples
    --------
    >>> list(spells(np.array([[0, 1, 1, 0, 1]], dtype=bool), np.zeros((1, 5), dtype=bool)))
    [(0, 1, 3), (0, 4, None)]
    """
    on = active & ~ended
    before = np.pad(on, ((0, 0), (1, 0)))[:, :-1]
    for unit, first in zip(*np.nonzero(on & ~before), strict=True):
        off = np.nonzero(~on[unit, first:])[0]
        yield int(unit), int(first), int(first + off[0]) if off.size else None


def occupied(shape: tuple[int, int], cases: Iterable[Case]) -> Array:
    """Flights during which any of `cases` was open. (units, flights) bool"""
    out = np.zeros(shape, dtype=bool)
    for case in cases:
        out[case.unit, case.raised : case.closed] = True
    return out
