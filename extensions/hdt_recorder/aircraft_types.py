"""Type descriptions: which parameter of the recorder is which column of the pack's or a component's record.

Read from TOML and checked against the columns that exist; an error names the file, the line and the key.
"""

import difflib
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hdt_core.components import recorded_components
from hdt_core.loading import parse_toml, read_text
from pipelines.intake.columns import SIGNAL_COLUMNS
from pipelines.intake.landing_file import MAX_PACKS

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
    """Raised for a type description that can't be used; names file, line, key and fault."""


@dataclass(frozen=True, slots=True)
class Station:
    """One column: the parameter of each unit and the conversion to the column's unit.

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
    """Describe what recorders of one type record.

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
        """Return whether its recordings become rows of the default record."""
        return PACK in self.stations

    @property
    def components(self) -> tuple[str, ...]:
        """Return the codes of the components in its recordings."""
        return tuple(code for code in self.stations if code != PACK)


def columns_of(table: str) -> tuple[str, ...]:
    """Return the columns that `pack` or a component's record may have."""
    if table == PACK:
        return tuple(c.name for c in SIGNAL_COLUMNS)
    record = recorded_components()[table.lower()].record
    return tuple(c.column for c in record.channels) if record else ()


def read_type(file: Path, map_folder: Path | None = None) -> AircraftType:
    """Read the type that a file describes; its map lies beside it, or else in `map_folder`.

    Raises
    ------
    AircraftTypeError
        Names file, line and key.
    """
    try:
        text = read_text(file)
        entries = parse_toml(text)
    except (OSError, UnicodeDecodeError) as error:
        raise AircraftTypeError(f"{file.name}: {getattr(error, 'strerror', None) or 'no text in UTF-8'}") from None
    except ValueError as error:
        raise AircraftTypeError(f"{file.name}: {error}") from None
    return _Description(file, text, entries).read(map_folder or file.parent)


@dataclass(frozen=True, slots=True)
class _Description:
    """Parse and check one description file."""

    file: Path
    text: str
    document: dict[str, Any]

    def read(self, map_folder: Path) -> AircraftType:
        self._check_keys(self.document, HEAD, "")
        name = self._text("type")
        packs = self._count(self.document, "packs", "", 2, MAX_PACKS)
        parts = {PACK: self._table(PACK)} | self._table("component")
        units = {PACK: packs} | {c: self._count(t, "units", c, packs, MAX_PACKS) for c, t in parts.items() if c != PACK}
        every_s = {c: self._count(t, "every_s", c, 0, 3600, 0) for c, t in parts.items() if c != PACK}
        stations = {c: tuple(self._stations(c, t, units[c])) for c, t in parts.items() if t}
        if not stations:
            raise self._wrong("", "component", "neither [pack] nor a [component.CODE]: nothing is described")
        return AircraftType(
            name, str(self.document.get("title", "")), self.file,
            self._file("map", map_folder), self._file("reports", map_folder) if "reports" in self.document else None,
            self._clock(), stations, units, {PACK: 1} | every_s, dict(self._absent(stations)),
        )  # fmt: skip

    def _file(self, key: str, map_folder: Path) -> Path:
        """Return the path of the map or the layouts; never outside the folders that may hold them."""
        name = self._text(key)
        path = next((f for f in (self.file.parent / name, map_folder / name) if f.is_file()), map_folder / name)
        if not any(path.resolve().is_relative_to(folder.resolve()) for folder in (self.file.parent, map_folder)):
            raise self._wrong("", key, f"{name} leads out of the folder")
        return path

    def _stations(self, table: str, entries: dict[str, Any], units: int) -> Iterator[Station]:
        if table != PACK and table.lower() not in recorded_components():
            codes = ", ".join(c.upper() for c in recorded_components())
            raise self._wrong("component", table, f"no component {table} has a record of its own; there are {codes}")
        columns = columns_of(table)
        for key, value in entries.items():
            if table != PACK and key in ("units", "every_s"):
                continue
            if key not in columns:
                near = difflib.get_close_matches(key, columns, 1)
                raise self._wrong(table, key, f"no such column; {f'{near[0]} is near' if near else _among(columns)}")
            yield self._station(table, key, value if isinstance(value, dict) else {"parameter": value}, units)

    def _station(self, table: str, key: str, entry: dict[str, Any], units: int) -> Station:
        self._check_keys(entry, ENTRY, table, key)
        value = entry.get("parameter", "")
        names = [value] * units if isinstance(value, str) else value
        if not isinstance(names, list) or not all(isinstance(n, str) for n in names) or not any(names):
            raise self._wrong(table, key, "a parameter's name, or a list of them, one a unit")
        if len(names) != units:
            raise self._wrong(table, key, f"{len(names)} parameters for {units} units")
        scale, offset = self._conversion(table, key, entry.get("unit", ""))
        low, high, rate_hz = (self._number(table, key, entry, k) for k in ("lowest", "highest", "rate_hz"))
        if (low is not None and high is not None and low >= high) or (rate_hz is not None and rate_hz <= 0.0):
            raise self._wrong(table, key, "lowest is below highest, and rate_hz above 0")
        unit = str(entry.get("unit", "")).lower()
        place = self._place(table, key)
        return Station(key, tuple(names), scale, offset, unit, low, high, rate_hz, place)

    def _conversion(self, table: str, key: str, unit: Any) -> tuple[float, float]:
        units = UNITS.get(key.rpartition("_")[2], {})
        if not unit:
            return 1.0, 0.0
        if str(unit).lower() not in units:
            choices = f"there are {', '.join(units)}" if units else "its column has none"
            raise self._wrong(table, key, f"unit {unit!r}; {choices}")
        return units[str(unit).lower()]

    def _number(self, table: str, key: str, entry: dict[str, Any], name: str) -> float | None:
        value = entry.get(name)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if value is not None and not (number and abs(value) <= MOST_NUMBER):
            raise self._wrong(table, key, f"{name} is a number, not {value!r:.40}")
        return None if value is None else float(value)

    def _clock(self) -> dict[str, str]:
        entries = self._table("clock")
        self._check_keys(entries, set(CLOCK), "clock")
        if entries and set(entries) != set(CLOCK):
            raise self._wrong("", "clock", f"{', '.join(CLOCK)} come together")
        return {k: str(v) for k, v in entries.items()}

    def _absent(self, stations: Mapping[str, tuple[Station, ...]]) -> Iterator[tuple[tuple[str, str], str]]:
        for table, reasons in self._table("absent").items():
            for column, why in (reasons if isinstance(reasons, dict) else {}).items():
                if table not in stations and table != PACK and table.lower() not in recorded_components():
                    raise self._wrong("absent", table, "neither pack nor a component")
                if column not in columns_of(table) or column in {s.column for s in stations.get(table, ())}:
                    raise self._wrong("absent", f"{table}.{column}", "no such column, or one that is described above")
                yield (table, column), str(why)

    def _table(self, name: str) -> dict[str, Any]:
        entries = self.document.get(name, {})
        if not isinstance(entries, dict):
            raise self._wrong("", name, "a table, [name]")
        return entries

    def _text(self, name: str) -> str:
        text = self.document.get(name)
        if not isinstance(text, str) or not text.strip() or not text.isprintable():
            raise self._wrong("", name, "missing; it is a text of one line")
        return text.strip()

    def _count(self, entries: Any, name: str, table: str, usual: int, most: int, least: int = 1) -> int:
        if not isinstance(entries, dict):
            raise self._wrong("component", table, "a table, [component.CODE]")
        count = entries.get(name, usual)
        if isinstance(count, bool) or not isinstance(count, int) or not least <= count <= most:
            raise self._wrong(table, name, f"a number from {least} to {most}, not {count!r}")
        return count

    def _check_keys(self, entries: dict[str, Any], keys: set[str], table: str, within: str = "") -> None:
        if odd := sorted(set(entries) - keys):
            raise self._wrong(table, within or odd[0], f"{odd[0]} means nothing; {_among(sorted(keys))}")

    def _wrong(self, table: str, key: str, what: str) -> AircraftTypeError:
        return AircraftTypeError(f"{self._place(table, key)}: {what}")

    def _place(self, table: str, key: str) -> str:
        """Return file, line, table and key; the line is that of the key below its table's head."""
        last = key.rpartition(".")[2]
        heads = (table, f"component.{table}")
        within = not table
        line = 0
        for number, content in enumerate(self.text.splitlines(), 1):
            if head := re.match(r"\s*\[+\s*([^\]]+?)\s*\]", content):
                within = head[1] in heads or (not table and head[1] == key)
                line = number if within and (head[1] == key or head[1].endswith(f".{key}")) else line
            elif within and re.match(rf"\s*(\S+\.)?{re.escape(last)}\s*=", content):
                line = number
                break
        at = f" line {line}" if line else ""
        return f"{self.file.name}{at}: {f'[{table}] ' if table else ''}{key}"


def _among(names: tuple[str, ...] | list[str]) -> str:
    return f"there are {', '.join(names)}"
