"""What the files of an aircraft are judged by: its line of `fleet.csv`, and its type from `types/` or a package."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from pipelines.aircraft_types import shipped
from pipelines.intake.aircraft_types import AircraftType, AircraftTypeError, read_type
from pipelines.intake.fleet_list import PACKS, FleetLine, fleet_lines

FOLDER, RECORDER, REPORTS = "types", "recorder", "reports"
"""Folder of the landing zone that holds descriptions and maps; folders of an aircraft: recordings, printed reports."""


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
        name = self.named.get((operator, tail), "")
        if not name:
            return "fleet.csv gives the aircraft no type"
        if name not in self.known:
            also = "; ".join(self.faults.values())
            known = ", ".join(sorted(self.known)) or "none"
            return f"fleet.csv gives the aircraft the type {name}, known are {known}" + (f" ({also})" if also else "")
        found = self.known[name]
        return "" if found.map_file.is_file() else f"{found.file.name} names the map {found.map_file.name}: not there"

    def judged_by(self, operator: str, tail: str, place: str) -> str:
        """What the files of a folder of an aircraft, or its log, are judged by beside themselves, as `name=value ...`.

        It stands on record with the hash of each file, so a file is read again when this changes, and only then. What
        is as usual (two packs, listed, the default record) is not written.
        """
        return " ".join(f"{name}={value}" for name, value in self._judged_by(operator, tail, place))

    def _judged_by(self, operator: str, tail: str, place: str) -> Iterator[tuple[str, object]]:
        line, kind = self.lines.get((operator, tail)), self.of(operator, tail)
        if line and line.packs != PACKS and place != REPORTS:
            yield "packs", line.packs
        if line and line.delivered_on and place == MAINTENANCE:
            yield "delivered_on", line.delivered_on
        if self.lines and not line and place not in (MESSAGES, MAINTENANCE, REPORTS):
            yield "unlisted", ",".join(sorted(o for o, t in self.lines if t == tail))
        other = {RECORDER: kind.map_file, REPORTS: kind.reports_file}.get(place) if kind else None
        if kind and other:
            yield "by", _hash_of(kind.file, other)


MESSAGES, MAINTENANCE = "messages.csv", "maintenance.csv"


def _hash_of(*files: Path) -> str:
    """Hash of what some files hold; of one that can't be read its name."""
    total = hashlib.blake2b(digest_size=16)
    for file in files:
        try:
            total.update(hashlib.blake2b(file.read_bytes()).digest())
        except OSError:
            total.update(file.name.encode())
    return total.hexdigest()


def types_of(landing: Path) -> Types:
    """Types of a landing zone; of a name that it describes itself, its own."""
    own = (f for f in sorted((landing / FOLDER).glob("*.toml")) if f.resolve().is_relative_to(landing.resolve()))
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
            found = read_type(file, Path(landing) / FOLDER)
            known[found.name] = found
        except AircraftTypeError as error:
            faults[file.name] = str(error)
    return Types(known, fleet_lines(Path(landing) / "fleet.csv"), faults)
