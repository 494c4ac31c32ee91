"""Aircraft types of a landing zone, described in `types/` or by a package, and the type of each aircraft."""

import hashlib
from dataclasses import dataclass, field
from functools import cache, lru_cache, partial
from pathlib import Path

from hdt_core.loading import load_entry_points
from hdt_recorder.aircraft_types import AircraftType, AircraftTypeError, read_type
from pipelines.intake.faults import Fault
from pipelines.intake.landing_file import RECORDER, Kind, LandingFile
from pipelines.intake.logs import FleetLine, fleet_lines
from pipelines.intake.readers import REPORTS, TYPES, KindOf, ReaderError


@dataclass(frozen=True)
class Types:
    """Types by name, lines of the fleet list by operator and tail, and descriptions that can't be used."""

    by_name: dict[str, AircraftType] = field(default_factory=dict)
    lines: dict[tuple[str, str], FleetLine] = field(default_factory=dict)
    faults: dict[str, str] = field(default_factory=dict)

    @property
    def type_names(self) -> dict[tuple[str, str], str]:
        """Return the type of each aircraft that has one."""
        return {aircraft: line.type for aircraft, line in self.lines.items() if line.type}

    def of(self, operator: str, tail: str) -> AircraftType | None:
        """Return the type of an aircraft; None where it is the default or not described."""
        line = self.lines.get((operator, tail))
        return self.by_name.get(line.type) if line else None

    def fault_of(self, operator: str, tail: str) -> str:
        """Return why recordings of an aircraft can't be read; empty where they can."""
        line = self.lines.get((operator, tail))
        if line is None or not line.type:
            return "fleet.csv gives the aircraft no type"
        name = line.type
        if name not in self.by_name:
            also = "; ".join(self.faults.values())
            names = ", ".join(sorted(self.by_name)) or "none"
            return f"fleet.csv gives the aircraft the type {name}, known are {names}" + (f" ({also})" if also else "")
        kind = self.by_name[name]
        return "" if kind.map_file.is_file() else f"{kind.file.name} names the map {kind.map_file.name}: not there"

    def kinds(self, operator: str, tail: str, folder: str) -> tuple[str, KindOf]:
        """Return the hash of a folder's description, or empty, and the function from a file's name to its kind."""
        kind = self.of(operator, tail)
        fault = self.fault_of(operator, tail)
        other = {RECORDER: kind.map_file, REPORTS: kind.reports_file}.get(folder) if kind else None
        by = _hash_of(kind.file, other) if kind and other else ""
        return by, _kind_of_report if folder == REPORTS else partial(_kind_of_recording, kind, fault)


def _kind_of_recording(kind: AircraftType | None, fault: str, name: str) -> Kind | Fault:
    """Return the kind of a recording, or the fault of an aircraft whose type can't read it."""
    if not name:
        return Fault("unexpected_name", detail="not a recording")
    if kind is None or fault:
        return Fault("unknown_type", detail=f"{fault}.")
    return "recorder" if kind.has_packs else "component"


def _kind_of_report(name: str) -> Kind | Fault:
    is_one = name.rpartition(".")[2].lower() in {"dat", "txt", "zip"}
    return "reports" if is_one else Fault("unexpected_name", detail="neither .dat, .txt nor .zip")


def _hash_of(*files: Path) -> str:
    """Return a hash of some files' contents; of an unreadable file, its name."""
    total = hashlib.blake2b(digest_size=16)
    for file in files:
        try:
            total.update(hashlib.blake2b(file.read_bytes()).digest())
        except OSError:
            total.update(file.name.encode())
    return total.hexdigest()


@cache
def packaged_files() -> tuple[Path, ...]:
    """Return the descriptions of this and other packages; an entry point of the group `hdt.types` names a path."""
    others = (Path(str(path)) for _, path in load_entry_points("hdt.types", "type of aircraft", ReaderError))
    return (*sorted((Path(__file__).parent / "types").glob("*.toml")), *others)


def types_of(landing: Path) -> Types:
    """Return the types of a landing zone; its own description of a name comes first."""
    own = (f for f in sorted((landing / TYPES).glob("*.toml")) if f.resolve().is_relative_to(landing.resolve()))
    files = (*packaged_files(), *own)
    fleet = landing / "fleet.csv"
    moments = tuple((str(f), f.stat().st_ctime_ns) for f in (*files, fleet) if f.is_file())
    return _types(str(landing), moments)


@lru_cache(maxsize=8)
def _types(landing: str, moments: tuple[tuple[str, int], ...]) -> Types:
    by_name = {}
    faults = {}
    for path, _ in moments:
        file = Path(path)
        if file.suffix != ".toml":
            continue
        try:
            kind = read_type(file, Path(landing) / TYPES)
            by_name[kind.name] = kind
        except AircraftTypeError as error:
            faults[file.name] = str(error)
    first_lines = {aircraft: lines[0] for aircraft, lines in fleet_lines(Path(landing)).items()}
    return Types(by_name, first_lines, faults)


def components_in(file: LandingFile) -> tuple[str, ...]:
    """Return the folders of the components that the type of a recording's aircraft describes."""
    kind = types_of(Path(file.landing)).of(file.operator, file.tail)
    return tuple(code.lower() for code in kind.components) if kind else ()
