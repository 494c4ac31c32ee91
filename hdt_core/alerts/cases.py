"""Cases on a fleet's grid of flights, each a diagnosis of one pack from a first flight to a last, and their limits."""

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import numpy as np
import polars as pl

from hdt_core.components.pack import CC, HX
from hdt_core.flight.legs import DOOR_STILL
from hdt_core.records.keys import LEG, PACK
from hdt_core.records.unit_index import first_flights
from hdt_core.robust import Array

UNOBSERVED = ("predicted", "prior_only")
"""Statuses of an estimate that the flight did not update, as in the view `health_parameters` (`is_observed`)."""


@dataclass(frozen=True, slots=True)
class Grid:
    """A fleet's flights, packed to the left.

    Attributes
    ----------
    units : DataFrame
        operator, tail, pack of each row.
    rows : DataFrame
        The frame of the grid, sorted by unit and departure.
    unit, flight : array
        Row and column in the grid of each row of `rows`.
    shape : tuple of int
        Units, and flights of the busiest unit.
    beside : tuple of array
        Row and column of every flight that both packs recorded, and row and column of the other pack's.
    """

    units: pl.DataFrame
    rows: pl.DataFrame
    unit: Array
    flight: Array
    shape: tuple[int, int]
    beside: tuple[Array, ...]

    @classmethod
    def from_frame(cls, frame: pl.DataFrame) -> "Grid":
        """Lay out a frame with operator, tail, pack, departed_at and flight_id."""
        rows = frame.sort(*PACK, "departed_at", "flight_id")
        units = rows.select(PACK).unique(maintain_order=True)
        place = rows.select(
            pl.struct(PACK).rle_id().cast(pl.Int64).alias("unit"),
            pl.int_range(pl.len()).over(PACK).cast(pl.Int64).alias("flight"),
        )
        flights = int(np.asarray(place["flight"].max() or 0)) + 1 if rows.height else 0
        where = rows.select(LEG).with_columns(place)
        other = where.with_columns(pack=3 - pl.col("pack"))
        pairs = where.join(other, on=LEG, how="inner", suffix="_other", validate="m:1")
        beside = tuple(pairs[c].to_numpy() for c in ("unit", "flight", "unit_other", "flight_other"))
        return cls(units, rows, place["unit"].to_numpy(), place["flight"].to_numpy(), (units.height, flights), beside)

    def values(self, name: str) -> Array:
        """Return a column as (units, flights) floats; NaN where null, absent or not flown."""
        out = np.full(self.shape, np.nan)
        if name in self.rows.columns:
            out[self.unit, self.flight] = self.rows[name].cast(pl.Float64).to_numpy()
        return out

    def flags(self, name: str) -> Array:
        """Return a column as (units, flights) booleans; False where null, absent or not flown."""
        return self.values(name) > 0.5

    def as_observed(self, flags: Array, name: str, restart: Array) -> Array:
        """Return `flags` as of the unit's last flight that updated the estimate `name`; False before the first one.

        A prediction drifts with the prior of any unit, and no alert rests on that.

        Parameters
        ----------
        flags, restart : array
            (units, flights) bool; flights with a new or cleaned unit.
        """
        flight = np.arange(self.shape[1])
        has_update = np.isfinite(self.values(name))
        has_update &= ~self.has_status(name, None, *UNOBSERVED)
        last = np.maximum.accumulate(np.where(has_update, flight, -1), axis=1)
        entry = np.maximum.accumulate(np.where(restart, flight, 0), axis=1)
        return np.asarray(np.take_along_axis(flags, np.maximum(last, 0), axis=1) & (last >= entry) & self.is_flight)

    def has_status(self, name: str, *statuses: str | None) -> Array:
        """Return whether an estimate's status is one of these; False where not flown. (units, flights) bool"""
        out = np.zeros(self.shape, dtype=bool)
        column = f"{name}_status"
        if column in self.rows.columns:
            out[self.unit, self.flight] = self.rows[column].is_in(statuses, nulls_equal=True).to_numpy()
        return out

    def value(self, name: str, unit: int, flight: int) -> object:
        """Return one value of one flight."""
        return self.rows[name][self._first_row(unit) + flight]

    def count(self, unit: int) -> int:
        """Count the flights of one unit."""
        return self._first_row(unit + 1) - self._first_row(unit)

    def track(self, name: str, unit: int) -> Array:
        """Return a column of one unit's flights; NaN where null or absent. (its flights,)"""
        if name not in self.rows.columns:
            return np.full(self.count(unit), np.nan)
        return self.rows[name].slice(self._first_row(unit), self.count(unit)).cast(pl.Float64).to_numpy()

    def _first_row(self, unit: int) -> int:
        """Return the first row of a unit in `rows`; the number of rows for the unit after the last."""
        return int(np.searchsorted(self.unit, unit))

    @property
    def is_flight(self) -> Array:
        """Cells that hold a flight. (units, flights) bool"""
        out = np.zeros(self.shape, dtype=bool)
        out[self.unit, self.flight] = True
        return out

    def departures(self) -> Array:
        """Return departure times as increasing integers; the largest integer where no flight was flown."""
        out = np.full(self.shape, np.iinfo(np.int64).max)
        out[self.unit, self.flight] = self.rows["departed_at"].to_physical().to_numpy()
        return out

    def partner(self) -> Array:
        """Return the row of the same aircraft's other pack; -1 where there is none. (units,)"""
        where = {(o, t, p): i for i, (o, t, p) in enumerate(self.units.rows())}
        return np.array([where.get((o, t, 3 - p), -1) for o, t, p in self.units.rows()], dtype=int)

    def across(self, values: Array) -> Array:
        """Return the other pack's values on the same flight; NaN (False for booleans) where not recorded."""
        out = np.full(values.shape, False if values.dtype == bool else np.nan, dtype=values.dtype)
        unit, flight, unit_other, flight_other = self.beside
        out[unit, flight] = values[unit_other, flight_other]
        return out

    def worked_on(self, maintenance: pl.DataFrame, components: tuple[str, ...], actions: tuple[str, ...]) -> Array:
        """Flag the first flight that counts as flown after such work, by `records.unit_index`. (units, flights) bool"""
        out = np.zeros(self.shape, dtype=bool)
        flights = self.rows.select(*PACK, "departed_at", pl.Series("u", self.unit), pl.Series("k", self.flight))
        first = first_flights(flights, maintenance, components, actions)
        out[first["u"].to_numpy(), first["k"].to_numpy()] = True
        return out


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


def sensor_of(case: Case) -> str | None:
    """Return the sensor at fault or, of a loss that was found clean, the component; None for other diagnoses."""
    return case.facts.get("sensor", case.facts.get("of"))


def alert_id_of(grid: Grid, case: Case) -> str:
    """Return the name of the alert: another where its first flight is another."""
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
