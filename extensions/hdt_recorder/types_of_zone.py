"""The types of a landing zone, described in `types/` or by a package, and which aircraft is of which."""

import hashlib
from dataclasses import dataclass, field
from functools import cache, lru_cache, partial
from pathlib import Path

from hdt_core.packages import load_entry_points
from hdt_recorder.aircraft_types import AircraftType, AircraftTypeError, read_type
from pipelines.intake.faults import Fault
from pipelines.intake.fleet_list import FleetLine, fleet_lines
from pipelines.intake.landing_file import RECORDER, Kind, LandingFile
from pipelines.intake.readers import REPORTS, TYPES, KindOf, ReaderError


@dataclass(frozen=True)
class Types:
    """Types that are known, lines of the fleet list by operator and tail, and descriptions that can't be used."""

    known: dict[str, AircraftType] = field(default_factory=dict)
    lines: dict[tuple[str, str], FleetLine] = field(default_factory=dict)
    faults: dict[str, str] = field(default_factory=dict)

    @property
    def named(self) -> dict[tuple[str, str], str]:
        """Type of each aircraft that has one."""
        return {aircraft: line.type for aircraft, line in self.lines.items() if line.type}

    def of(self, operator: str, tail: str) -> AircraftType | None:
        """The type of an aircraft; None where it is the default or not described."""
        line = self.lines.get((operator, tail))
        return self.known.get(line.type) if line else None

    def fault_of(self, operator: str, tail: str) -> str:
        """Why recordings of an aircraft can't be read; empty where they can."""
        line = self.lines.get((operator, tail))
        if line is None or not line.type:
            return "fleet.csv gives the aircraft no type"
        name = line.type
        if name not in self.known:
            also = "; ".join(self.faults.values())
            known = ", ".join(sorted(self.known)) or "none"
            return f"fleet.csv gives the aircraft the type {name}, known are {known}" + (f" ({also})" if also else "")
        found = self.known[name]
        return "" if found.map_file.is_file() else f"{found.file.name} names the map {found.map_file.name}: not there"

    def kinds(self, operator: str, tail: str, folder: str) -> tuple[str, KindOf]:
        """Hash of the description that a folder's files are read by, or empty; and the kind of a file by its name."""
        kind, fault = self.of(operator, tail), self.fault_of(operator, tail)
        other = {RECORDER: kind.map_file, REPORTS: kind.reports_file}.get(folder) if kind else None
        by = _hash_of(kind.file, other) if kind and other else ""
        return by, _printed if folder == REPORTS else partial(_recording, kind, fault)


def _recording(kind: AircraftType | None, fault: str, name: str) -> Kind | Fault:
    """Recordings of an aircraft whose type says how to read them."""
    if not name:
        return Fault("unexpected_name", detail="not a recording")
    if kind is None or fault:
        return Fault("unknown_type", detail=f"{fault}.")
    return "recorder" if kind.has_packs else "component"


def _printed(name: str) -> Kind | Fault:
    is_one = name.rpartition(".")[2].lower() in {"dat", "txt", "zip"}
    return "reports" if is_one else Fault("unexpected_name", detail="neither .dat, .txt nor .zip")


def _hash_of(*files: Path) -> str:
    """Hash of what some files hold; of one that can't be read its name."""
    total = hashlib.blake2b(digest_size=16)
    for file in files:
        try:
            total.update(hashlib.blake2b(file.read_bytes()).digest())
        except OSError:
            total.update(file.name.encode())
    return total.hexdigest()


@cache
def shipped() -> tuple[Path, ...]:
    """Descriptions that come along, and those of packages: an entry point of the group `hdt.types` names a path."""
    others = (Path(str(found)) for _, found in load_entry_points("hdt.types", "type of aircraft", ReaderError))
    return (*sorted((Path(__file__).parent / "types").glob("*.toml")), *others)


def types_of(landing: Path) -> Types:
    """Types of a landing zone; of a name that it describes itself, its own."""
    own = (f for f in sorted((landing / TYPES).glob("*.toml")) if f.resolve().is_relative_to(landing.resolve()))
    files = (*shipped(), *own)
    fleet = landing / "fleet.csv"
    moments = tuple((str(f), f.stat().st_ctime_ns) for f in (*files, fleet) if f.is_file())
    return _types(str(landing), moments)


@lru_cache(maxsize=8)
def _types(landing: str, moments: tuple[tuple[str, int], ...]) -> Types:
    known, faults = {}, {}
    for path, _ in moments:
        file = Path(path)
        if file.suffix != ".toml":
            continue
        try:
            found = read_type(file, Path(landing) / TYPES)
            known[found.name] = found
        except AircraftTypeError as error:
            faults[file.name] = str(error)
    return Types(known, fleet_lines(Path(landing)), faults)


def components_in(file: LandingFile) -> tuple[str, ...]:
    """Folders of the components that the type of a recording's aircraft describes."""
    kind = types_of(Path(file.landing)).of(file.operator, file.tail)
    return tuple(code.lower() for code in kind.components) if kind else ()
