"""Convert a recording to rows, as if a file of the contract or of a component had been delivered."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import numpy.typing as npt
import polars as pl

from hdt_recorder.aircraft_types import UNITS, AircraftType, AircraftTypeError, Station
from hdt_recorder.decoding.decode import Series
from hdt_recorder.decoding.fit import decode
from hdt_recorder.decoding.layout import Damage, MapError, Parameter
from hdt_recorder.recordings import MOST_BYTES, open_recording, unpacked_bytes
from hdt_recorder.types_of_zone import types_of
from pipelines.intake.faults import Fault
from pipelines.intake.landing_file import LandingFile

Floats = npt.NDArray[np.float64]
MAP_UNITS = {"deg c": "degc", "degree c": "degc", "deg f": "degf", "mbar": "mbar", "hpa": "hpa", "psi": "psia",
             "psia": "psia", "feet": "ft", "ft": "ft", "rpm": "rpm", "percent": "pct", "percen": "pct"}  # fmt: skip
"""Units of maps that are beyond doubt, as `UNITS` calls them."""
RATE_OFF = 0.1
SLACK_S = 0.5
DAY_S = 86400.0
MOST_ROWS = 1_000
"""Rows of a component and unit that describe a flight well enough."""
MOST_S = 172_800.0
"""Longest recording that can be one flight."""


def recorder_rows(file: LandingFile, table: str) -> tuple[pl.DataFrame, int, list[Fault]]:
    """Return rows of `pack` or of a component's code in the columns of its files, their count and the file's faults.

    Returns
    -------
    DataFrame
        `flight_id`, `report_time` (UTC), `pack`, the described columns, `row` from 1. One row a second and pack; of a
        component as often as the type says. None where every value is missing.
    """
    types = types_of(Path(file.landing))
    kind = types.of(file.operator, file.tail)
    why = types.fault_of(file.operator, file.tail)
    flight = file.flight
    if kind is None or why or flight is None or unpacked_bytes(Path(file.full_path)) > MOST_BYTES:
        return pl.DataFrame(), 0, [_fault_before_opening(why, flight)]
    try:
        recording, layout = open_recording(Path(file.full_path), kind.map_file)
        stations = kind.stations[table]
        check_type(kind, layout.parameters, table)
        parameters = _parameters(kind, stations, layout.parameters)
        by_name = {series.parameter.name: series for series in decode(recording, parameters)}
    except MapError as error:
        return pl.DataFrame(), 0, [Fault("map_does_not_fit", detail=str(error))]
    except AircraftTypeError as error:
        return pl.DataFrame(), 0, [Fault("bad_type", detail=str(error))]
    faults = _damage_faults(recording.damage)
    rows, range_faults = _rows(kind, table, by_name)
    if rows.is_empty():
        return pl.DataFrame(), 0, [*faults, Fault("no_rows")]
    day = datetime.strptime(flight[-11:-3], "%Y%m%d").replace(tzinfo=UTC)
    start = day + timedelta(seconds=_clock_s(kind, by_name))
    moment = pl.lit(start).dt.cast_time_unit("us") + pl.duration(microseconds=(pl.col("t_s") * 1e6).round())
    result = rows.with_row_index("row", 1).with_columns(pl.lit(flight).alias("flight_id"), moment.alias("report_time"))
    return result.with_columns(pl.col("row").cast(pl.Int64)).drop("t_s"), rows.height, [*faults, *range_faults]


def _fault_before_opening(why: str, flight: str | None) -> Fault:
    """Return the fault that rejects a recording before it is opened."""
    if why:
        return Fault("unknown_type", detail=f"{why}.")
    if flight is None:
        return Fault("unexpected_name", detail="A recording is named after its flight.")
    return Fault("too_large", detail=f"A recording has {MOST_BYTES >> 20} MiB at most.")


def check_type(kind: AircraftType, parameters: Mapping[str, Parameter], table: str) -> None:
    """Raise `AircraftTypeError` where a description disagrees with the map."""
    for name in kind.clock.values():
        _readable_parameter(parameters, name, kind, f"{kind.file.name}: clock")
    for station in kind.stations[table]:
        for name in filter(None, station.parameters):
            parameter = _readable_parameter(parameters, name, kind, station.place)
            _check_unit(station, parameter)
            if station.rate_hz and abs(parameter.rate_hz / station.rate_hz - 1.0) > RATE_OFF:
                difference = f"{name} is {station.rate_hz:g} Hz by the type, {parameter.rate_hz:g} Hz by the map"
                raise AircraftTypeError(f"{station.place}: {difference}")


def _readable_parameter(parameters: Mapping[str, Parameter], name: str, kind: AircraftType, place: str) -> Parameter:
    if name not in parameters:
        raise AircraftTypeError(f"{place}: {kind.map_file.name} has no parameter {name}")
    if reason := parameters[name].unreadable:
        raise AircraftTypeError(f"{place}: {name} has no value: {reason}")
    return parameters[name]


def _check_unit(station: Station, parameter: Parameter) -> None:
    unit = station.column.rpartition("_")[2]
    by_map = MAP_UNITS.get(parameter.unit.strip().lower(), "")
    if not station.unit and by_map in UNITS.get(unit, {}) and UNITS[unit][by_map] != (1.0, 0.0):
        difference = f"{parameter.name} is in {parameter.unit} by its map, the column in {unit}"
        raise AircraftTypeError(f'{station.place}: {difference}; say unit = "{by_map}"')


def _parameters(
    kind: AircraftType, stations: Sequence[Station], parameters: Mapping[str, Parameter]
) -> list[Parameter]:
    names = [n for s in stations for n in s.parameters if n]
    return [parameters[n] for n in dict.fromkeys([*names, *kind.clock.values()])]


def _damage_faults(damage: Damage) -> list[Fault]:
    counts = asdict(damage)
    losses = {k: counts[k] for k in ("damaged", "missing", "breaks", "skipped_bytes") if counts[k]}
    summary = ", ".join(f"{n:,} {k.replace('_', ' ')}" for k, n in losses.items())
    return [Fault("recording_damaged", detail=f"{damage.unit}: {damage.whole:,} whole, {summary}.")] if losses else []


def _rows(kind: AircraftType, table: str, by_name: Mapping[str, Series]) -> tuple[pl.DataFrame, list[Fault]]:
    """Return a row per time and unit with at least one value, and faults for values outside the type's ranges."""
    stations = kind.stations[table]
    faults = []
    times = [by_name[n].t_s for s in stations for n in s.parameters if n in by_name and by_name[n].t_s.size]
    if not times:
        return pl.DataFrame(), []
    first = min(t[0] for t in times)
    last = min(max(t[-1] for t in times), min(t[0] for t in times) + MOST_S)
    every_s = kind.every_s[table] or max(1.0, np.ceil((last - first) / MOST_ROWS))
    t_s = np.arange(np.floor(first), np.floor(last) + 1.0, every_s)
    parts = []
    for unit in range(kind.units[table]):
        columns = {}
        for s in stations:
            values, n_outside = _column(s, by_name.get(s.parameters[unit]), t_s)
            columns[s.column] = values
            if n_outside:
                detail = f"{s.parameters[unit]}: {n_outside:,} values outside the type's range."
                faults.append(Fault("out_of_range", None, s.column, detail))
        parts.append(pl.DataFrame({"t_s": t_s, "pack": np.full(t_s.size, unit + 1.0), **columns}))
    rows = pl.concat(parts).with_columns(pl.selectors.float().fill_nan(None))
    something = pl.any_horizontal(pl.col(s.column).is_not_null() for s in stations)
    return rows.filter(something).sort("t_s", "pack"), faults


def _column(station: Station, series: Series | None, t_s: Floats) -> tuple[Floats, int]:
    """Return values at the rows' times, in the column's unit; NaN where missing or outside the type's range."""
    if series is None or series.value is None:
        return np.full(t_s.size, np.nan), 0
    value = _at(series, t_s) * station.scale + station.offset
    low, high = (b if b is not None else s * np.inf for b, s in ((station.lowest, -1.0), (station.highest, 1.0)))
    outside = (value < low) | (value > high)
    return np.where(outside, np.nan, value), int(outside.sum())


def _at(series: Series, t_s: Floats) -> Floats:
    """Return the last value of each row's second; of slow parameters the last before, at most one period old."""
    assert series.value is not None
    value = np.where(series.valid, series.value, np.nan)
    place = np.searchsorted(series.t_s, t_s + 1.0, "left") - 1
    index = np.clip(place, 0, None)
    old = t_s - series.t_s[index] > max(1.0 / series.parameter.rate_hz, 1.0) + SLACK_S
    return np.asarray(np.where((place < 0) | old, np.nan, value[index]))


def _clock_s(kind: AircraftType, by_name: Mapping[str, Series]) -> float:
    """Return UTC seconds after midnight at the recording's time 0; 0 where it has no clock."""
    if not kind.clock:
        return 0.0
    hour, minute, second = (by_name.get(kind.clock[k]) for k in ("hour", "minute", "second"))
    if second is None or minute is None or hour is None or not second.valid.any():
        return 0.0
    t_s = second.t_s[second.valid]
    parts = [_nearest(s, t_s) for s in (hour, minute, second)]
    ahead = parts[0] * 3600.0 + parts[1] * 60.0 + parts[2] - np.floor(t_s)
    ahead = ahead[np.isfinite(ahead)]
    if not ahead.size:
        return 0.0
    wrapped_s = (ahead - ahead[0] + DAY_S / 2.0) % DAY_S - DAY_S / 2.0
    start_s = float(np.round(ahead[0] + np.median(wrapped_s)) % DAY_S)
    return start_s - DAY_S if start_s + t_s[0] >= DAY_S else start_s


def _nearest(series: Series, t_s: Floats) -> Floats:
    """Return the value of the sample nearest in time."""
    if series.value is None or not series.valid.any():
        return np.full(t_s.size, np.nan)
    times = series.t_s[series.valid]
    value = series.value[series.valid]
    after = np.clip(np.searchsorted(times, t_s), 0, times.size - 1)
    before = np.clip(after - 1, 0, None)
    return np.asarray(value[np.where(t_s - times[before] <= times[after] - t_s, before, after)])
