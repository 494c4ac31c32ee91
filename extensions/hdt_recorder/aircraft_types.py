"""A type description: which parameter of the recorder is which column of the pack's or a component's record.

Read from TOML, and held against the columns that there are: an error names the file, the line and the key.
"""

import difflib
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hdt_core.components import recorded_components
from hdt_core.toml_text import parse_toml
from pipelines.intake.columns import SIGNAL_COLUMNS
from pipelines.intake.names import MAX_PACKS

PACK = "pack"
CLOCK = ("hour", "minute", "second")
HEAD = {"type", "title", "map", "reports", "packs", "clock", PACK, "component", "absent"}
MOST_NUMBER = 1e12
ENTRY = {"parameter", "unit", "lowest", "highest", "rate_hz"}
UNITS: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "degc": {"degc": (1.0, 0.0), "degf": (5 / 9, -160 / 9), "k": (1.0, -273.15)},
    "psia": {"psia": (1.0, 0.0), "mbar": (0.0145037738, 0.0), "hpa": (0.0145037738, 0.0), "kpa": (0.145037738, 0.0),
             "inhg": (0.491154, 0.0)},
    "ft": {"ft": (1.0, 0.0), "m": (3.28083990, 0.0)},
    "lbpm": {"lbpm": (1.0, 0.0), "lb/min": (1.0, 0.0), "kg/s": (132.277357, 0.0), "kg/min": (2.20462262, 0.0)},
    "pct": {"pct": (1.0, 0.0), "%": (1.0, 0.0), "share": (100.0, 0.0)},
    "rpm": {"rpm": (1.0, 0.0)},
}  # fmt: skip
"""Of the unit that ends a column's name, what a recorder may have instead: column = recorded * scale + offset."""


class AircraftTypeError(ValueError):
    """A type description that can't be used; says file, line, key and what is wrong."""


@dataclass(frozen=True, slots=True)
class Station:
    """One column: the parameter of each unit, and how it becomes the column's unit.

    Attributes
    ----------
    parameters : tuple of str
        One a unit; empty for a unit that has none.
    unit : str
        Of the recorder, as in `UNITS`; empty where the description says none.
    lowest, highest : float, optional
        Outside them a value is a reading of nothing. [column's unit]
    rate_hz : float, optional
        Values a second that the map must give it.
    place : str
        File, line, table and key, for messages.
    """

    column: str
    parameters: tuple[str, ...]
    scale: float
    offset: float
    unit: str
    lowest: float | None
    highest: float | None
    rate_hz: float | None
    place: str


@dataclass(frozen=True, slots=True)
class AircraftType:
    """What recorders of one type hold.

    Attributes
    ----------
    name, title : str
        `name` is what `fleet.csv` calls it.
    map_file : Path
        Parameter map.
    reports_file : Path, optional
        Layouts of its printed reports; those of the A330 where not given.
    clock : mapping
        Parameters of UTC hour, minute and second; empty where the recorder has none.
    stations : mapping
        Columns by `pack` or the code of a component.
    units, every_s : mapping
        How many units of each an aircraft has; seconds from one row to the next, 0 for what makes a thousand rows.
    absent : mapping
        Why a column is not recorded, by `pack` or code and column.
    """

    name: str
    title: str
    file: Path
    map_file: Path
    reports_file: Path | None
    clock: Mapping[str, str]
    stations: Mapping[str, tuple[Station, ...]]
    units: Mapping[str, int]
    every_s: Mapping[str, int]
    absent: Mapping[tuple[str, str], str] = field(default_factory=dict)

    @property
    def has_packs(self) -> bool:
        """Whether its recordings become rows of the default record."""
        return PACK in self.stations

    @property
    def components(self) -> tuple[str, ...]:
        """Codes of the components that its recordings hold."""
        return tuple(code for code in self.stations if code != PACK)


def columns_of(table: str) -> tuple[str, ...]:
    """Columns that `pack` or a component's record may have."""
    if table == PACK:
        return tuple(c.name for c in SIGNAL_COLUMNS)
    record = recorded_components()[table.lower()].record
    return tuple(c.column for c in record.channels) if record else ()


def read_type(file: Path, map_folder: Path | None = None) -> AircraftType:
    """The type that a file describes; its map lies beside it, or else in `map_folder`.

    Raises
    ------
    AircraftTypeError
        Names file, line and key.
    """
    try:
        text = file.read_text("utf-8")
        said = parse_toml(text)
    except (OSError, UnicodeDecodeError) as error:
        raise AircraftTypeError(f"{file.name}: {getattr(error, 'strerror', None) or 'no text in UTF-8'}") from None
    except ValueError as error:
        raise AircraftTypeError(f"{file.name}: {error}") from None
    return _Description(file, text, said).read(map_folder or file.parent)


@dataclass(frozen=True, slots=True)
class _Description:
    """One file on the way to a type."""

    file: Path
    text: str
    said: dict[str, Any]

    def read(self, map_folder: Path) -> AircraftType:
        self._known(self.said, HEAD, "")
        name, packs = self._text("type"), self._count(self.said, "packs", "", 2, MAX_PACKS)
        parts = {PACK: self._table(PACK)} | self._table("component")
        units = {PACK: packs} | {c: self._count(t, "units", c, packs, MAX_PACKS) for c, t in parts.items() if c != PACK}
        every_s = {c: self._count(t, "every_s", c, 0, 3600, 0) for c, t in parts.items() if c != PACK}
        stations = {c: tuple(self._stations(c, t, units[c])) for c, t in parts.items() if t}
        if not stations:
            raise self._wrong("", "component", "neither [pack] nor a [component.CODE]: nothing is described")
        return AircraftType(
            name, str(self.said.get("title", "")), self.file,
            self._file("map", map_folder), self._file("reports", map_folder) if "reports" in self.said else None,
            self._clock(), stations, units, {PACK: 1} | every_s, dict(self._absent(stations)),
        )  # fmt: skip

    def _file(self, key: str, map_folder: Path) -> Path:
        """Where the map or the layouts lie, or should; never outside the folders that may hold them."""
        named = self._text(key)
        found = next((f for f in (self.file.parent / named, map_folder / named) if f.is_file()), map_folder / named)
        if not any(found.resolve().is_relative_to(folder.resolve()) for folder in (self.file.parent, map_folder)):
            raise self._wrong("", key, f"{named} leads out of the folder")
        return found

    def _stations(self, table: str, entries: dict[str, Any], units: int) -> Iterator[Station]:
        if table != PACK and table.lower() not in recorded_components():
            known = ", ".join(c.upper() for c in recorded_components())
            raise self._wrong("component", table, f"no component {table} has a record of its own; there are {known}")
        wanted = columns_of(table)
        for key, value in entries.items():
            if table != PACK and key in ("units", "every_s"):
                continue
            if key not in wanted:
                near = difflib.get_close_matches(key, wanted, 1)
                raise self._wrong(table, key, f"no such column; {f'{near[0]} is near' if near else _among(wanted)}")
            yield self._station(table, key, value if isinstance(value, dict) else {"parameter": value}, units)

    def _station(self, table: str, key: str, entry: dict[str, Any], units: int) -> Station:
        self._known(entry, ENTRY, table, key)
        named = entry.get("parameter", "")
        names = [named] * units if isinstance(named, str) else named
        if not isinstance(names, list) or not all(isinstance(n, str) for n in names) or not any(names):
            raise self._wrong(table, key, "a parameter's name, or a list of them, one a unit")
        if len(names) != units:
            raise self._wrong(table, key, f"{len(names)} parameters for {units} units")
        scale, offset = self._conversion(table, key, entry.get("unit", ""))
        low, high, rate_hz = (self._number(table, key, entry, k) for k in ("lowest", "highest", "rate_hz"))
        if (low is not None and high is not None and low >= high) or (rate_hz is not None and rate_hz <= 0.0):
            raise self._wrong(table, key, "lowest is below highest, and rate_hz above 0")
        unit, place = str(entry.get("unit", "")).lower(), self._place(table, key)
        return Station(key, tuple(names), scale, offset, unit, low, high, rate_hz, place)

    def _conversion(self, table: str, key: str, unit: Any) -> tuple[float, float]:
        known = UNITS.get(key.rpartition("_")[2], {})
        if not unit:
            return 1.0, 0.0
        if str(unit).lower() not in known:
            said = f"there are {', '.join(known)}" if known else "its column has none"
            raise self._wrong(table, key, f"unit {unit!r}; {said}")
        return known[str(unit).lower()]

    def _number(self, table: str, key: str, entry: dict[str, Any], name: str) -> float | None:
        value = entry.get(name)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if value is not None and not (number and abs(value) <= MOST_NUMBER):
            raise self._wrong(table, key, f"{name} is a number, not {value!r:.40}")
        return None if value is None else float(value)

    def _clock(self) -> dict[str, str]:
        said = self._table("clock")
        self._known(said, set(CLOCK), "clock")
        if said and set(said) != set(CLOCK):
            raise self._wrong("", "clock", f"{', '.join(CLOCK)} come together")
        return {k: str(v) for k, v in said.items()}

    def _absent(self, stations: Mapping[str, tuple[Station, ...]]) -> Iterator[tuple[tuple[str, str], str]]:
        for table, reasons in self._table("absent").items():
            for column, why in (reasons if isinstance(reasons, dict) else {}).items():
                if table not in stations and table != PACK and table.lower() not in recorded_components():
                    raise self._wrong("absent", table, "neither pack nor a component")
                if column not in columns_of(table) or column in {s.column for s in stations.get(table, ())}:
                    raise self._wrong("absent", f"{table}.{column}", "no such column, or one that is described above")
                yield (table, column), str(why)

    def _table(self, name: str) -> dict[str, Any]:
        found = self.said.get(name, {})
        if not isinstance(found, dict):
            raise self._wrong("", name, "a table, [name]")
        return found

    def _text(self, name: str) -> str:
        found = self.said.get(name)
        if not isinstance(found, str) or not found.strip() or not found.isprintable():
            raise self._wrong("", name, "missing; it is a text of one line")
        return found.strip()

    def _count(self, said: Any, name: str, table: str, usual: int, most: int, least: int = 1) -> int:
        if not isinstance(said, dict):
            raise self._wrong("component", table, "a table, [component.CODE]")
        found = said.get(name, usual)
        if isinstance(found, bool) or not isinstance(found, int) or not least <= found <= most:
            raise self._wrong(table, name, f"a number from {least} to {most}, not {found!r}")
        return found

    def _known(self, said: dict[str, Any], keys: set[str], table: str, within: str = "") -> None:
        if odd := sorted(set(said) - keys):
            raise self._wrong(table, within or odd[0], f"{odd[0]} means nothing; {_among(sorted(keys))}")

    def _wrong(self, table: str, key: str, what: str) -> AircraftTypeError:
        return AircraftTypeError(f"{self._place(table, key)}: {what}")

    def _place(self, table: str, key: str) -> str:
        """File, line, table and key; the line is that of the key below its table's head."""
        last, heads = key.rpartition(".")[2], (table, f"component.{table}")
        within, line = not table, 0
        for number, written in enumerate(self.text.splitlines(), 1):
            if head := re.match(r"\s*\[+\s*([^\]]+?)\s*\]", written):
                within = head[1] in heads or (not table and head[1] == key)
                line = number if within and (head[1] == key or head[1].endswith(f".{key}")) else line
            elif within and re.match(rf"\s*(\S+\.)?{re.escape(last)}\s*=", written):
                line = number
                break
        at = f" line {line}" if line else ""
        return f"{self.file.name}{at}: {f'[{table}] ' if table else ''}{key}"


def _among(names: tuple[str, ...] | list[str]) -> str:
    return f"there are {', '.join(names)}"
