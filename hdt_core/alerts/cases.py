"""Cases: a diagnosis of one pack from its first flight to its last, and the limits at which a case is raised."""

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import numpy as np

from hdt_core.alerts.grid import Grid
from hdt_core.components.pack import CC, HX
from hdt_core.flight.legs import DOOR_STILL
from hdt_core.robust import Array

REPAIR = ("REPLACED", "CLEANED", "ADJUSTED")
"""Actions that change a part, so that its level before them no longer counts."""
DIAMETER_SD = 0.022
"""Flight-to-flight scatter of the effective diameter of a sound compressor, relative. [-]"""
FAILS_AT = HX.limit.mean
"""Loss of conductance at which packs of the first fleets ran out of ram door; used where the margin is unknown."""
WEAR_LIMIT = 0.05
"""Loss from which a unit counts as worn at all. [-]"""
Persistence = tuple[int, int, int]
"""Flagged flights of how many open a case, and flights since the last that keeps it which close it. [flights]"""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits at which a case is raised. Losses and openings are fractions.

    Attributes
    ----------
    fouling, fouling_odds : float
        Loss of conductance to plan work for, and the probability of its exceedance that raises a case: about six packs
        in 1,000 flights come this far, and two of them may be called too early.
    fouling_soon, soon_odds, soon_flights : float
        Where the margin is not known: a smaller loss, the probability of its exceedance, and the flights within which
        its trend leads to `FAILS_AT`: about a month of warning, which a shop visit takes.
    fouling_keep : float
        Share of `fouling_soon` above which a case of fouling stays open.
    clog : float
        Increase of loss within three flights, beyond the trend, that calls for a look at the core: nine sigma of the
        difference, and three times the dust that one bad station leaves.
    ram_flow : float
        Loss of ram flow with it, where a ram outlet probe is fitted; below it is a film, not a blockage.
    passage, passage_keep : float
        Chance of the message within 300 flights, by physics alone, that calls for a plan though the loss is small, and
        the share of it above which the case stays open.
    compressor, compressor_odds, compressor_excess, compressor_keep : float
        Efficiency loss worth a case, the probability of its exceedance, and the multiples of it that the estimate must
        exceed to open a case and to keep it open.
    lost_share : float
        Share of empty readings; a sound sensor loses 1 %.
    still_span : float
        Travel of a door from climb to descent below which it does not follow, as in the leg filter.
    peg_k : float
        Outlet above its target while the door rests, not open, at its widest: four sigma of a sound flight.
    wear_persistence, clog_persistence, margin_persistence, compressor_persistence : Persistence
    jam_persistence, dropout_persistence : Persistence
        Flights that open and close a case of wear, clog, margin, compressor, jam and dropout.
    """

    fouling: float = HX.warn_loss
    fouling_odds: float = 0.7
    fouling_soon: float = 0.09
    soon_odds: float = 0.8
    soon_flights: float = 100.0
    fouling_keep: float = 0.75
    clog: float = 0.1
    ram_flow: float = 0.04
    passage: float = 0.9
    passage_keep: float = 0.6
    compressor: float = CC.warn_loss
    compressor_odds: float = 0.9
    compressor_excess: float = 1.2
    compressor_keep: float = 0.7
    lost_share: float = 0.2
    still_span: float = DOOR_STILL
    peg_k: float = 1.3
    wear_persistence: Persistence = (3, 4, 15)
    clog_persistence: Persistence = (1, 1, 30)
    margin_persistence: Persistence = (4, 5, 20)
    compressor_persistence: Persistence = (4, 5, 20)
    jam_persistence: Persistence = (2, 3, 4)
    dropout_persistence: Persistence = (2, 3, 8)


@dataclass(slots=True)
class Case:
    """One diagnosis of a pack; `raised_flight` and `closed_flight` are the pack's flights, the latter None while open.

    `facts` are those it was raised with; `facts_at` returns, after any flight, what only its own rule measures;
    `ended_at` is when work ended a case still open after the pack's last flight. `closed_reason` and `ended_reason` are
    `recovered` (the flights no longer show it), `renewed` (another or a repaired part flies) or `found_clean`.
    """

    unit: int
    component: str
    diagnosis: str
    raised_flight: int
    closed_flight: int | None
    facts: dict[str, Any] = field(default_factory=dict)
    facts_at: Callable[[int], dict[str, Any]] = lambda flight: {}
    ended_at: datetime | None = None
    closed_reason: str = "recovered"
    ended_reason: str | None = None


def fact_after(name: str, values: Array) -> Callable[[int], dict[str, float]]:
    """Return `Case.facts_at` for one measure. `values` (flights,)."""
    return lambda flight: {name: float(values[flight])}


def case_id(grid: Grid, case: Case) -> str:
    """Return the name of a case in the catalog, which later data do not change."""
    unit = map(str, grid.units.row(case.unit))
    flight_id = str(grid.value("flight_id", case.unit, case.raised_flight))
    name = "|".join((*unit, case.component, case.diagnosis, flight_id, str(case.facts.get("sensor", ""))))
    return hashlib.sha256(name.encode()).hexdigest()[:16]


def runs(active: Array, restart: Array) -> Iterator[tuple[int, int, int | None]]:
    """Yield runs of `active`, cut at `restart`: unit, first flight, flight after the last (None while it lasts).

    Examples
    --------
    >>> list(runs(np.array([[0, 1, 1, 0, 1]], dtype=bool), np.zeros((1, 5), dtype=bool)))
    [(0, 1, 3), (0, 4, None)]
    """
    active = active & ~restart
    before = np.pad(active, ((0, 0), (1, 0)))[:, :-1]
    for unit, first in zip(*np.nonzero(active & ~before), strict=True):
        off = np.nonzero(~active[unit, first:])[0]
        yield int(unit), int(first), int(first + off[0]) if off.size else None


def open_flights(shape: tuple[int, int], cases: Iterable[Case]) -> Array:
    """Flag the flights on which any of `cases` was open. (units, flights) bool"""
    out = np.zeros(shape, dtype=bool)
    for case in cases:
        out[case.unit, case.raised_flight : case.closed_flight] = True
    return out
