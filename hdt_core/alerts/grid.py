"""Features as arrays: one row a pack, one column a flight, so that a rule computes a whole fleet at once."""

from dataclasses import dataclass

import numpy as np
import polars as pl

from hdt_core.records.keys import PACK
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
        where = rows.select("operator", "tail", "flight_id", "pack").with_columns(place)
        other = where.with_columns(pack=3 - pl.col("pack"))
        pairs = where.join(
            other, on=["operator", "tail", "flight_id", "pack"], how="inner", suffix="_other", validate="m:1"
        )
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
        if f"{name}_status" in self.rows.columns:
            is_prediction = self.rows[f"{name}_status"].is_in(UNOBSERVED).fill_null(True).to_numpy()
            has_update[self.unit, self.flight] &= ~is_prediction
        last = np.maximum.accumulate(np.where(has_update, flight, -1), axis=1)
        entry = np.maximum.accumulate(np.where(restart, flight, 0), axis=1)
        return np.asarray(np.take_along_axis(flags, np.maximum(last, 0), axis=1) & (last >= entry) & self.is_flight)

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
