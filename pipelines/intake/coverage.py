"""What can be estimated of aircraft of each type, and which columns are missing for the rest."""

from collections.abc import Iterator, Mapping

import polars as pl

from hdt_core.components import Component, components, recorded_components
from hdt_core.recorder.layout import MapError, Parameter
from hdt_core.tables.raw import RawCoverage
from pipelines.intake.aircraft_types import PACK, AircraftType, AircraftTypeError
from pipelines.intake.recorder_rows import check_type
from pipelines.intake.recordings import read_map
from pipelines.intake.types_of_zone import Types

Row = tuple[str, str, str, str, str]
"""Component, parameter, status, missing columns, why they are missing."""


def coverage(types: Types) -> pl.DataFrame:
    """`raw_coverage`: a row for each aircraft that has a type, and parameter."""
    rows = [
        (operator, tail, kind.name, *row)
        for (operator, tail), name in sorted(types.named.items())
        if (kind := types.known.get(name)) is not None
        for row in coverage_of(kind)
    ]
    return pl.DataFrame(rows, schema=dict.fromkeys(RawCoverage.columns(), pl.String), orient="row")


def coverage_of(kind: AircraftType) -> Iterator[Row]:
    """What a type's recordings can tell of the pack's own parts, and of the components it describes."""
    for component in components().values():
        for parameter, needed in component.needs.items():
            yield _row(kind, PACK, component, parameter, needed)
        if component.code in kind.stations:
            channels = recorded_components()[component.folder].record
            needed = tuple(c.column for c in channels.channels if c.needed) if channels else ()
            yield _row(kind, component.code, component, component.loss, needed)


def _row(kind: AircraftType, table: str, component: Component, parameter: str, needed: tuple[str, ...]) -> Row:
    there = {s.column for s in kind.stations.get(table, ())}
    missing = [c for c in needed if c not in there]
    explained = [c for c in missing if (table, c) in kind.absent] or missing
    why = dict.fromkeys(kind.absent.get((table, c), "not described") for c in explained)
    status = "not_recorded" if missing else "recorded"
    return component.code, parameter, status, ", ".join(explained), "; ".join(why)


def faults_of(kind: AircraftType) -> list[str]:
    """What is wrong between a description and its map, before any recording comes."""
    if not kind.map_file.is_file():
        return [f"{kind.file.name}: no map {kind.map_file.name} in {kind.map_file.parent.name}/"]
    try:
        parameters = read_map(kind.map_file).parameters
    except (MapError, OSError) as error:
        return [str(error)]
    return [told for table in kind.stations if (told := _told(kind, parameters, table))]


def _told(kind: AircraftType, parameters: Mapping[str, Parameter], table: str) -> str:
    try:
        check_type(kind, parameters, table)
    except AircraftTypeError as error:
        return str(error)
    return ""


def in_use(types: Types) -> dict[str, int]:
    """Aircraft of each type that the fleet list names."""
    names = list(types.named.values())
    return {name: names.count(name) for name in sorted(set(names))}
