"""Faults of a record as they come by: eleven kinds, each of a size drawn log-uniformly, at a random place.

A fault changes one aircraft's files and names what a reason may name: the flights it changed, or the packs whose log it
changed.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import date, datetime, timedelta
from pathlib import Path

import numpy as np
import polars as pl

Flights = Mapping[str, pl.DataFrame]
YEAR_S = 365 * 86_400
STAMP = "%Y-%m-%dT%H:%M:%SZ"
STEPS = {
    "hx_in_degc": 0.25, "hx_out_degc": 0.25, "pack_flow_lbpm": 0.25, "ram_out_degc": 0.25, "cc_speed_rpm": 8.0,
    "cc_out_degc": 0.25, "cc_out_psia": 0.02, "ram_door_pct": 0.5, "tat_degc": 0.25, "altitude_ft": 4.0,
}  # fmt: skip
"""Steps in which the sample fleet's recorders write."""


@dataclass(frozen=True)
class Record:
    """What one aircraft's ground station delivers.

    Attributes
    ----------
    landing : Path
        Landing zone that it was read from, where other aircraft have their files.
    """

    landing: Path
    operator: str
    tail: str
    flights: Flights
    messages: pl.DataFrame
    maintenance: pl.DataFrame

    def write(self, landing: Path) -> None:
        """Write the files: one a flight, and the two logs."""
        folder = landing / self.operator / self.tail
        (folder / "acms").mkdir(parents=True)
        for flight, rows in self.flights.items():
            rows.write_csv(folder / "acms" / f"{flight}.csv", datetime_format=STAMP)
        self.messages.write_csv(folder / "messages.csv", datetime_format=STAMP)
        self.maintenance.write_csv(folder / "maintenance.csv")


@dataclass(frozen=True)
class Fault:
    """A record with a fault.

    Attributes
    ----------
    size : float
        In the kind's unit.
    flights : frozenset of str
        Flights that the fault changed, as they are called before and after it; empty where it changed a log.
    """

    kind: str
    size: float
    flights: frozenset[str]
    record: Record


def read_record(landing: Path, operator: str, tail: str, first: date, last: date) -> Record:
    """Read an aircraft's reports and logs between two days."""
    folder = landing / operator / tail
    files = sorted((folder / "acms").iterdir())
    readers = {".csv": lambda f: pl.read_csv(f, infer_schema_length=None), ".parquet": pl.read_parquet}
    frames = [readers[f.suffix](f) for f in files]
    at = pl.col("report_time")
    rows = pl.concat([_typed(f) for f in frames], how="diagonal_relaxed").filter(at.dt.date().is_between(first, last))
    flights = {str(f): own for (f,), own in rows.partition_by("flight_id", as_dict=True, maintain_order=True).items()}
    messages = pl.read_csv(folder / "messages.csv").with_columns(
        pl.col("message_time").str.to_datetime(STAMP, time_zone="UTC")
    )
    maintenance = pl.read_csv(folder / "maintenance.csv", try_parse_dates=True)
    return Record(
        landing, operator, tail, dict(sorted(flights.items())),
        messages.filter(pl.col("message_time").dt.date().is_between(first, last)),
        maintenance.filter(pl.col("done_on").is_between(first, last)),
    )  # fmt: skip


def _typed(rows: pl.DataFrame) -> pl.DataFrame:
    """Return the rows with times and numbers as such; a column without a value is one of numbers."""
    at = pl.col("report_time")
    times = at.str.to_datetime(STAMP, time_zone="UTC") if rows.schema["report_time"] == pl.String else at
    numbers = [name for name in rows.columns if name not in ("flight_id", "report_time", "phase_code", "pack")]
    return rows.with_columns(times.cast(pl.Datetime("us", "UTC")), pl.col(numbers).cast(pl.Float64))


def draw_size(rng: np.random.Generator, least: float, most: float) -> float:
    """Draw a size log-uniformly."""
    return float(np.exp(rng.uniform(np.log(least), np.log(most))))


def shift(rng: np.random.Generator, record: Record) -> Fault:
    """Shift the times of one flight by a second to ten years, either way."""
    flight = _any_flight(rng, record)
    size_s = draw_size(rng, 1.0, 10 * YEAR_S)
    sign = rng.choice([-1, 1])
    rows = _moved(record.flights[flight], timedelta(seconds=round(sign * size_s)))
    return _changed("shift", size_s, record, {flight: rows}, {flight})


def redate(rng: np.random.Generator, record: Record) -> Fault:
    """Write one flight under a date a day to ten years off, in its name too."""
    flight = _any_flight(rng, record)
    days = round(draw_size(rng, 1.0, 3_650.0))
    change = timedelta(days=int(rng.choice([-1, 1])) * days)
    day = _day(flight) + change
    name = _free_leg(record, flight, day)
    rows = _named(_moved(record.flights[flight], change), name)
    return _changed("redate", days, record, {name: rows}, {flight, name}, without={flight})


def copy(rng: np.random.Generator, record: Record) -> Fault:
    """Deliver a flight again under another leg, a second to three hours later, half of them with a decimal less."""
    flight = _any_flight(rng, record)
    size_s = draw_size(rng, 1.0, 10_800.0)
    name = _free_leg(record, flight, _day(flight))
    rows = _named(_moved(record.flights[flight], timedelta(seconds=round(size_s))), name)
    if rng.random() < 0.5:
        rows = rows.with_columns(pl.col(pl.Float64).round(1))
    return _changed("copy", size_s, record, {name: rows}, {flight, name})


def split(rng: np.random.Generator, record: Record) -> Fault:
    """Cut one flight in two, the second part, of five minutes and more, under a leg of its own."""
    flight = _any_flight(rng, record)
    rows = record.flights[flight]
    at = pl.col("report_time")
    size_min = draw_size(rng, 5.0, _duration_min(rows))
    cut = at.max() - timedelta(minutes=size_min)
    name = _free_leg(record, flight, _day(flight))
    parts = {flight: rows.filter(at < cut), name: _named(rows.filter(at >= cut), name)}
    return _changed("split", size_min, record, {f: part for f, part in parts.items() if part.height}, {flight, name})


def join(rng: np.random.Generator, record: Record) -> Fault:
    """Record the first minutes of a flight, or all of it, under the flight before it."""
    names = list(record.flights)
    place = int(rng.integers(len(names) - 1))
    first = names[place]
    second = names[place + 1]
    rows = record.flights[second]
    at = pl.col("report_time")
    size_min = draw_size(rng, 5.0, _duration_min(rows) + 1.0)
    cut = at.min() + timedelta(minutes=size_min)
    joined = pl.concat([record.flights[first], _named(rows.filter(at < cut), first)], how="diagonal_relaxed")
    rest = rows.filter(at >= cut)
    kept = {second: rest} if rest.height else {}
    return _changed("join", size_min, record, {first: joined, **kept}, {first, second}, without={second})


def renumber(rng: np.random.Generator, record: Record) -> Fault:
    """Give one flight, or all of its day from it on, a leg number that is one to nine higher."""
    flight = _any_flight(rng, record)
    legs = round(draw_size(rng, 1.0, 9.0))
    same_day = [f for f in record.flights if f[:-3] == flight[:-3] and f >= flight]
    renamed = same_day if rng.random() < 0.5 else [flight]
    names = {f: f"{f[:-2]}{int(f[-2:]) + legs:02d}" for f in renamed}
    if (set(record.flights) - set(renamed)) & set(names.values()):
        names = {f: f"{f[:-2]}{int(f[-2:]) + 50:02d}" for f in renamed}
    rows = {new: _named(record.flights[old], new) for old, new in names.items()}
    return _changed("renumber", legs, record, rows, {*names, *names.values()}, without=set(names))


def swap(rng: np.random.Generator, record: Record) -> Fault:
    """Exchange the packs on one to a hundred flights in a row."""
    changed = _flights_in_a_row(rng, record, round(draw_size(rng, 1.0, 100.0)))
    rows = {f: record.flights[f].with_columns(pack=3 - pl.col("pack")) for f in changed}
    return _changed("swap", len(changed), record, rows, set(changed))


def coarsen(rng: np.random.Generator, record: Record) -> Fault:
    """Write a signal in steps one to ten times as coarse from some flight on."""
    recorded = [name for name in STEPS if all(name in rows.columns for rows in record.flights.values())]
    signal = str(rng.choice(recorded))
    size = draw_size(rng, 1.0, 10.0)
    names = list(record.flights)
    changed = names[int(rng.integers(len(names))) :]
    step = size * STEPS[signal]
    rows = {f: record.flights[f].with_columns((pl.col(signal) / step).round() * step) for f in changed}
    return _changed("coarsen", size, record, rows, set(changed))


def duplicate(rng: np.random.Generator, record: Record) -> Fault:
    """Write a line of the maintenance log again, one to sixty days later."""
    days = round(draw_size(rng, 1.0, 60.0))
    work = record.maintenance
    line = work[int(rng.integers(work.height))].with_columns(pl.col("done_on") + timedelta(days=days))
    again = pl.concat([work, line])
    return Fault("duplicate", days, frozenset(), replace(record, maintenance=again))


def relabel(rng: np.random.Generator, record: Record) -> Fault:
    """Write a line of the maintenance log a day to sixty days off, or at the other pack."""
    days = round(draw_size(rng, 1.0, 60.0))
    work = record.maintenance.with_row_index()
    is_line = pl.col("index") == int(rng.integers(work.height))
    if rng.random() < 0.25:
        wrong = work.with_columns(pl.when(is_line).then(3 - pl.col("pack")).otherwise("pack").alias("pack"))
        days = 0
    else:
        change = timedelta(days=int(rng.choice([-1, 1])) * days)
        off = pl.when(is_line).then(pl.col("done_on") + change).otherwise("done_on")
        wrong = work.with_columns(off.alias("done_on"))
    return Fault("relabel", days, frozenset(), replace(record, maintenance=wrong.drop("index")))


def misfile(rng: np.random.Generator, record: Record) -> Fault:
    """Deliver another aircraft's flight of the operator under this tail too, at a time at which this one stands."""
    tails = sorted(folder.name for folder in (record.landing / record.operator).iterdir())
    tail = str(rng.choice([other for other in tails if other != record.tail]))
    other = read_record(record.landing, record.operator, tail, _day(min(record.flights)), _day(max(record.flights)))
    flight = str(rng.choice([name for name, rows in other.flights.items() if _is_in_gap(rows, record)]))
    name = _free_leg(record, f"{record.tail}{flight[-12:]}", _day(flight))
    return _changed("misfile", 1.0, record, {name: _named(other.flights[flight], name)}, {name})


def leave_out(rng: np.random.Generator, record: Record) -> Fault:
    """Leave out one flight: no fault, but a measure of what chance moves."""
    flight = _any_flight(rng, record)
    return _changed("left out", 1.0, record, {}, {flight}, without={flight})


KINDS: Mapping[str, Callable[[np.random.Generator, Record], Fault]] = {
    kind.__name__: kind
    for kind in (shift, redate, copy, split, join, renumber, swap, coarsen, duplicate, relabel, misfile)
}
UNITS = {
    "shift": "s", "redate": "days", "copy": "s", "split": "min", "join": "min", "renumber": "legs", "swap": "flights",
    "coarsen": "steps", "duplicate": "days", "relabel": "days", "misfile": "flights",
}  # fmt: skip


def _any_flight(rng: np.random.Generator, record: Record) -> str:
    return str(rng.choice(list(record.flights)))


def _flights_in_a_row(rng: np.random.Generator, record: Record, n: int) -> list[str]:
    names = list(record.flights)
    start = int(rng.integers(len(names) - n + 1))
    return names[start : start + n]


def _duration_min(rows: pl.DataFrame) -> float:
    first, last = _span(rows)
    return float((last - first).total_seconds()) / 60.0


def _is_in_gap(rows: pl.DataFrame, record: Record) -> bool:
    """Return whether a flight overlaps none of an aircraft's and does not lie before or after all of them."""
    start, end = _span(rows)
    spans = [_span(own) for own in record.flights.values()]
    earlier = [span for span in spans if span[1] < start]
    later = [span for span in spans if span[0] > end]
    return bool(earlier and later) and len(earlier) + len(later) == len(spans)


def _span(rows: pl.DataFrame) -> tuple[datetime, datetime]:
    first, last = rows.select(first=pl.col("report_time").min(), last=pl.col("report_time").max()).row(0)
    return first, last


def _day(flight: str) -> date:
    return date(int(flight[-11:-7]), int(flight[-7:-5]), int(flight[-5:-3]))


def _free_leg(record: Record, flight: str, day: date) -> str:
    """Return a name on a day: the flight's leg where no other has it, or the next number that is free."""
    start = f"{flight[:-12]}_{day:%Y%m%d}_"
    legs = (f"{start}{leg:02d}" for leg in range(int(flight[-2:]), 100))
    return next(name for name in legs if name not in record.flights)


def _moved(rows: pl.DataFrame, change: timedelta) -> pl.DataFrame:
    return rows.with_columns(pl.col("report_time") + change)


def _named(rows: pl.DataFrame, flight: str) -> pl.DataFrame:
    return rows.with_columns(flight_id=pl.lit(flight))


def _changed(
    kind: str, size: float, record: Record, rows: Flights, names: set[str], without: set[str] | None = None
) -> Fault:
    """Return a record with some flights replaced, added or, `without`, taken away."""
    kept = {f: own for f, own in record.flights.items() if f not in (without or set())}
    return Fault(kind, size, frozenset(names), replace(record, flights=kept | dict(rows)))
