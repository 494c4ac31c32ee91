"""Which aircraft of a landing zone is of which type: `fleet.csv` names it, `types/` or a package describes it."""

import csv
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from pipelines.aircraft_types import shipped
from pipelines.intake.aircraft_types import AircraftType, AircraftTypeError, read_type

FOLDER, RECORDER, REPORTS = "types", "recorder", "reports"
"""Folder of the landing zone that holds descriptions and maps; folders of an aircraft: recordings, printed reports."""


@dataclass(frozen=True)
class Types:
    """Types that are known, those of aircraft by operator and tail, and descriptions that can't be used."""

    known: dict[str, AircraftType] = field(default_factory=dict)
    named: dict[tuple[str, str], str] = field(default_factory=dict)
    faults: dict[str, str] = field(default_factory=dict)

    def of(self, operator: str, tail: str) -> AircraftType | None:
        """The type of an aircraft; None where it is the default or not described."""
        return self.known.get(self.named.get((operator, tail), ""))

    def fault_of(self, operator: str, tail: str) -> str:
        """Why recordings of an aircraft can't be read; empty where they can."""
        name = self.named.get((operator, tail), "")
        if not name:
            return "fleet.csv gives the aircraft no type"
        if name not in self.known:
            also = "; ".join(self.faults.values())
            known = ", ".join(sorted(self.known)) or "none"
            return f"fleet.csv gives the aircraft the type {name}, known are {known}" + (f" ({also})" if also else "")
        found = self.known[name]
        return "" if found.map_file.is_file() else f"{found.file.name} names the map {found.map_file.name}: not there"


def read_by(landing: Path, operator: str, tail: str, folder: str) -> tuple[Path, ...]:
    """Files by which those of a folder of an aircraft are read: description and map, or layouts of printed reports."""
    kind = types_of(landing).of(operator, tail) if folder in (RECORDER, REPORTS) else None
    if kind is None:
        return ()
    other = kind.map_file if folder == RECORDER else kind.reports_file
    return (kind.file, other) if other else ()


def types_of(landing: Path) -> Types:
    """Types of a landing zone; of a name that it describes itself, its own."""
    own = (f for f in sorted((landing / FOLDER).glob("*.toml")) if f.resolve().is_relative_to(landing.resolve()))
    files = (*shipped(), *own)
    fleet = landing / "fleet.csv"
    moments = tuple((str(f), f.stat().st_mtime_ns) for f in (*files, fleet) if f.is_file())
    return _types(str(landing), moments)


@lru_cache(maxsize=8)
def _types(landing: str, moments: tuple[tuple[str, int], ...]) -> Types:
    known, faults = {}, {}
    for path, _ in moments:
        file = Path(path)
        if file.suffix != ".toml":
            continue
        try:
            found = read_type(file, Path(landing) / FOLDER)
            known[found.name] = found
        except AircraftTypeError as error:
            faults[file.name] = str(error)
    return Types(known, _named(Path(landing) / "fleet.csv"), faults)


def _named(fleet: Path) -> dict[tuple[str, str], str]:
    """Type of each aircraft by the fleet list; what is wrong with the list is told where it is taken in."""
    try:
        lines = fleet.read_text("utf-8-sig", errors="replace").splitlines()
        rows = [{k.strip().lower(): (v or "").strip() for k, v in r.items() if k and not isinstance(v, list)}
                for r in csv.DictReader(lines)]  # fmt: skip
    except (OSError, csv.Error):
        return {}
    return {(r.get("operator", ""), r.get("tail", "")): r["type"] for r in rows if r.get("type")}
