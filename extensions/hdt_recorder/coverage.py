"""Which parameters can be estimated for each aircraft type, and which columns are missing for the rest."""

from collections.abc import Iterator
from pathlib import Path

import polars as pl

from hdt_core.components import Component, components, recorded_components
from hdt_core.tables.raw import RawCoverage
from hdt_recorder.aircraft_types import PACK, AircraftType, AircraftTypeError
from hdt_recorder.decoding.layout import MapError
from hdt_recorder.recorder_rows import check_type
from hdt_recorder.recordings import read_map
from hdt_recorder.types_of_zone import types_of

Row = tuple[str, str, str, str, str]
"""Component, parameter, status, missing columns, why they are missing."""


def coverage(landing: Path) -> pl.DataFrame:
    """Return `raw_coverage`: a row per aircraft that has a type, and parameter."""
    types = types_of(landing)
    rows = [
        (operator, tail, kind.name, *row)
        for (operator, tail), name in sorted(types.type_names.items())
        if (kind := types.by_name.get(name)) is not None
        for row in coverage_of(kind)
    ]
    return pl.DataFrame(rows, schema=dict.fromkeys(RawCoverage.columns(), pl.String), orient="row")


def coverage_of(kind: AircraftType) -> Iterator[Row]:
    """Return the estimable parameters of the pack's own parts and of the components a type describes."""
    for component in components().values():
        for parameter, columns in component.needs.items():
            yield _row(kind, PACK, component, parameter, columns)
        if component.code in kind.stations:
            channels = recorded_components()[component.folder].record
            columns = tuple(c.column for c in channels.channels if c.needed) if channels else ()
            yield _row(kind, component.code, component, component.loss, columns)


def _row(kind: AircraftType, table: str, component: Component, parameter: str, columns: tuple[str, ...]) -> Row:
    there = {s.column for s in kind.stations.get(table, ())}
    missing = [c for c in columns if c not in there]
    reasons = [c for c in missing if (table, c) in kind.absent] or missing
    why = dict.fromkeys(kind.absent.get((table, c), "not described") for c in reasons)
    status = "not_recorded" if missing else "recorded"
    return component.code, parameter, status, ", ".join(reasons), "; ".join(why)


def faults_of(kind: AircraftType) -> list[str]:
    """Return the disagreements between a description and its map, before any recording comes."""
    if not kind.map_file.is_file():
        return [f"{kind.file.name}: no map {kind.map_file.name} in {kind.map_file.parent.name}/"]
    try:
        parameters = read_map(kind.map_file).parameters
    except (MapError, OSError) as error:
        return [str(error)]
    wrong = []
    for table in kind.stations:
        try:
            check_type(kind, parameters, table)
        except AircraftTypeError as error:
            wrong.append(str(error))
    return wrong


def checks(landing: Path) -> Iterator[tuple[str, bool, str]]:
    """Check each type's description against its map and list what can't be estimated, as lines of `hdt doctor`."""
    types = types_of(landing)
    for file, fault in types.faults.items():
        yield f"type {file}", False, fault
    names = list(types.type_names.values())
    for name in sorted(set(names)):
        kind = types.by_name.get(name)
        if kind is None:
            names_known = ", ".join(sorted(types.by_name)) or "none"
            yield f"type {name}", False, f"fleet.csv names it, nothing describes it; there are {names_known}"
            continue
        wrong = faults_of(kind)
        rows = list(coverage_of(kind))
        lacks = ", ".join(f"{row[1]} (no {row[3]})" for row in rows if row[3]) or "nothing else"
        can = ", ".join(row[1] for row in rows if not row[3]) or "nothing"
        summary = f"{names.count(name)} aircraft; estimates {can}; can't estimate {lacks}"
        yield f"type {name}", not wrong, "; ".join(wrong) or summary
