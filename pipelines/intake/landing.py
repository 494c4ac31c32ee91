"""List the files of the landing zone with operator, tail and kind.

Entries that do not belong there go to quarantine.
"""

import os
import stat
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import date, datetime
from functools import partial
from pathlib import Path
from typing import NamedTuple

import polars as pl

from hdt_core.components import recorded_components
from pipelines.intake.airframes import find_airframes, overlapping_folders, undated_folders
from pipelines.intake.faults import Fault, quarantine
from pipelines.intake.landing_file import (
    PACKS,
    RECORDER,
    Aircraft,
    Kind,
    LandingFile,
    flight_day,
    flight_of_file,
    is_operator,
    is_tail,
    modified_at,
)
from pipelines.intake.logs import FleetLines, fleet_lines
from pipelines.intake.readers import NO_READER, REPORTS, TYPES, Zone, readers
from pipelines.storage.ledger import Ledger

PART = (".part", ".partial")
"""Ends of the names of files that are still being written."""
MAX_NS = 2**63 - 1
"""Farthest time from 1970 that a ledger holds."""
FLEET_LIST, MESSAGES, MAINTENANCE = "fleet.csv", "messages.csv", "maintenance.csv"


class Landing(NamedTuple):
    """Files to read, and a quarantine row for each entry that is none."""

    files: list[LandingFile]
    quarantine: pl.DataFrame


class _Listing:
    """Files and faults of one walk over the zone."""

    def __init__(self, landing: Path, ledger: Ledger | None) -> None:
        self.root = str(landing.resolve())
        self.files: list[LandingFile] = []
        self.faults: list[tuple[str, Fault, datetime]] = []
        self.lines = fleet_lines(landing.resolve())
        lines = [line for own in self.lines.values() for line in own]
        days = {folder: _flight_days(self.root, folder, ledger) for folder in undated_folders(lines)}
        self.apart = overlapping_folders(lines, days)
        self.airframes = find_airframes(lines, self.apart)
        self.own = {*_KINDS, *recorded_components()}
        self.zones: dict[str, Zone] = {}

    def reject(self, path: str, reason: str, detail: str, mtime_ns: int = 0) -> None:
        at = modified_at(mtime_ns)
        self.faults.append((_printable(path), Fault(reason, detail=detail), at))

    def entries(self, below: str) -> Iterator[os.DirEntry[str]]:
        """Yield the entries of a folder but those that are hidden, still being written or lead out of the zone."""
        try:
            entries = sorted(os.scandir(f"{self.root}/{below}" if below else self.root), key=lambda e: e.name)
        except OSError as error:
            self.reject(below, "cannot_open", error.strerror or type(error).__name__)
            return
        for entry in entries:
            if entry.name.endswith(PART) or entry.name.startswith("."):
                continue
            if not below and entry.name == TYPES in readers():
                continue
            if entry.is_symlink() and not self._stays_inside(entry.path):
                detail = "a link that leaves the landing zone or leads nowhere"
                self.reject(_join(below, entry.name), "outside_landing", detail)
                continue
            yield entry

    def folders(self, below: str, fits: Callable[[str], bool], what: str) -> Iterator[str]:
        """Yield the folders in `below` that fit; add the logs that belong there and reject everything else."""
        for entry in self.entries(below):
            path = _join(below, entry.name)
            if entry.is_dir() and fits(entry.name):
                yield entry.name
            elif not self._add_log(entry, path):
                no_reader = entry.name in (RECORDER, REPORTS, TYPES)
                self.reject(path, "unexpected_name", NO_READER if no_reader else f"not {what}")

    def add(self, entry: os.DirEntry[str], path: str, kind: Kind, context: str = "") -> None:
        """Add a regular file; reject pipes and devices, which would block the reader."""
        try:
            status = entry.stat()
        except OSError as error:
            self.reject(path, "cannot_open", error.strerror or type(error).__name__)
            return
        if not stat.S_ISREG(status.st_mode):
            self.reject(path, "not_a_file", "only regular files are read", status.st_mtime_ns)
            return
        operator, _, rest = path.partition("/")
        tail = rest.partition("/")[0]
        keys = ("", "") if kind in ("fleet", "type", "checks") else (operator, tail)
        if abs(status.st_mtime_ns) > MAX_NS:
            self.reject(path, "bad_file_time", "")
            return
        times = status.st_mtime_ns, max(status.st_ctime_ns, status.st_mtime_ns)
        in_fleet_list = keys == ("", "") or keys in self.lines
        words = filter(None, (context, self._airframe_word(kind, keys, entry.name)))
        file = LandingFile(self.root, path, *keys, kind, status.st_size, *times, " ".join(words), in_fleet_list)
        self.files.append(file)

    def _airframe_word(self, kind: Kind, folder: Aircraft, name: str) -> str:
        """Give the airframes that a file belongs to, where these are others than that of its folder's name."""
        if kind == "fleet":
            names = sorted(":".join(folder) for folder in self.apart)
            return f"apart={','.join(names)}" if names else ""
        tenures = self.airframes.tenures(folder)
        flight = flight_of_file(name, folder[1])
        day = flight_day(flight) if flight else None
        if day:
            tenures = [t for t in tenures if t.since <= day][-1:]
            tenures = [replace(t, since=date.min) for t in tenures]
        if not tenures or [(t.airframe, t.prefix) for t in tenures] == [(folder, "")]:
            return ""
        return f"airframe={';'.join(map(str, tenures))}"

    def _add_log(self, entry: os.DirEntry[str], path: str) -> bool:
        """Add fleet.csv at the top and the logs of a tail; whether the entry is one of them."""
        kind = _LOGS.get((path.count("/"), entry.name))
        if kind is None or entry.is_dir():
            return False
        place = path.split("/")
        self.add(entry, path, kind, reading_context(self.lines, *place) if len(place) == 3 else "")
        return True

    def has_reader(self, folder: str) -> bool:
        """Return whether files of a folder of an aircraft are read."""
        return folder in self.own or (folder != TYPES and folder in readers())

    def zone(self, folder: str) -> Zone:
        """Open the zone with the reader of a folder."""
        if folder not in self.zones:
            self.zones[folder] = readers()[folder].open_zone(Path(self.root))
        return self.zones[folder]

    def _stays_inside(self, path: str) -> bool:
        target = os.path.realpath(path)
        return target.startswith(self.root + "/") and os.path.exists(target)


_LOGS: dict[tuple[int, str], Kind] = {
    (0, FLEET_LIST): "fleet", (0, "checks.csv"): "checks", (0, "checks.parquet"): "checks",
    (2, MESSAGES): "messages", (2, MAINTENANCE): "maintenance",
}  # fmt: skip


def list_landing(landing: Path, ledger: Ledger | None = None) -> Landing:
    """List all files of the contract below `landing`, sorted by path; `.part` files are incomplete and ignored.

    Of lines of one msn without dates the flights say whether they follow each other, those of the ledger among them.
    Per-flight files of an unusual name are listed too (their column names the flight). Entries that fit no pattern,
    lead out of the zone or are no regular file become quarantine rows.
    """
    walk = _Listing(landing, ledger)
    _descriptions(walk)
    for operator in walk.folders("", is_operator, _OPERATOR):
        for tail in walk.folders(operator, is_tail, _TAIL):
            aircraft = f"{operator}/{tail}"
            for folder in walk.folders(aircraft, walk.has_reader, "a file or folder of the contract"):
                _add_flights(walk, f"{aircraft}/{folder}", folder)
    frames = [quarantine(path, at, [fault]) for path, fault, at in walk.faults]
    return Landing(walk.files, pl.concat([quarantine("", None, []), *frames]))


def _descriptions(walk: _Listing) -> None:
    """List the type descriptions of the zone; the other files beside them are maps."""
    if not os.path.isdir(f"{walk.root}/{TYPES}") or TYPES not in readers():
        return
    faults = walk.zone(TYPES).faults
    for name, fault in faults.items():
        walk.reject(f"{TYPES}/{name}", "bad_type", fault)
    for entry in walk.entries(TYPES):
        if entry.name.endswith(".toml") and entry.name not in faults:
            walk.add(entry, f"{TYPES}/{entry.name}", "type")


def _add_flights(walk: _Listing, below: str, folder: str) -> None:
    operator, tail, _ = below.split("/")
    default_reader = "", partial(_kind_in, folder)
    reader_version, kind_of = default_reader if folder in walk.own else walk.zone(folder).kinds(operator, tail, folder)
    context = reading_context(walk.lines, operator, tail, folder, reader_version)
    for entry in walk.entries(below):
        path = f"{below}/{entry.name}"
        kind = kind_of(entry.name if entry.name.isprintable() and not entry.is_dir() else "")
        if isinstance(kind, Fault):
            walk.reject(path, kind.reason, kind.detail)
        else:
            walk.add(entry, path, kind, context)


def reading_context(lines: FleetLines, operator: str, tail: str, place: str, reader_version: str = "") -> str:
    """Give what determines, beside its content, how a file of a folder or a log is read, as `name=value ...`.

    It is recorded with the hash of each file, so a file is read again when this changes, and only then. Defaults (two
    packs, listed, the default record) are left out. `reader_version` is the version of the folder's reader.
    """
    line = next(iter(lines.get((operator, tail), ())), None)
    words = list[str]()
    if line and line.packs != PACKS and place != REPORTS:
        words.append(f"packs={line.packs}")
    if line and line.delivered_on and place == MAINTENANCE:
        words.append(f"delivered_on={line.delivered_on}")
    if lines and not line and place not in (MESSAGES, MAINTENANCE, REPORTS):
        words.append(f"unlisted={','.join(sorted(o for o, t in lines if t == tail))}")
    return " ".join([*words, f"by={reader_version}"] if reader_version else words)


_OPERATOR = "fleet.csv, checks.csv or an operator's folder: 2 to 8 capitals and digits, first a letter"
_TAIL = "an aircraft's folder: its registration, 2 to 10 capitals, digits and hyphens"
_COMPONENT_NAMES = "neither .csv nor .parquet"
_PACK_NAMES = "neither <TAIL>_<YYYYMMDD>_<LEG> nor history_<YYYY-MM>, .csv or .parquet"
_KINDS: dict[str, dict[str, Kind]] = {"acms": {"csv": "acms", "parquet": "history"}, "cpl": {"parquet": "cpl"}}
_COMPONENT: dict[str, Kind] = {"csv": "component", "parquet": "component"}


def _kind_in(folder: str, name: str) -> Kind | Fault:
    kind = _KINDS.get(folder, _COMPONENT).get(name.rpartition(".")[2].lower())
    return kind or Fault("unexpected_name", detail=_PACK_NAMES if folder in _KINDS else _COMPONENT_NAMES)


def _join(below: str, name: str) -> str:
    return f"{below}/{name}" if below else name


def _printable(name: str) -> str:
    """Replace control characters and undecodable bytes of a name, for a log line or a table."""
    if name.isprintable():
        return name
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in name)


def _flight_days(root: str, folder: Aircraft, ledger: Ledger | None) -> list[date]:
    """List the days of the flights of an operator and tail, in the landing zone and on record."""
    from pipelines.intake.snapshots import flights_in

    below = "/".join(folder)
    flights = {
        c[3].rpartition(".")[2] for c in (ledger.cells_of_files() if ledger else ()) if c[0].startswith(f"{below}/")
    }
    for kinds in (*_KINDS, *recorded_components()):
        for file in Path(root, below, kinds).glob("*"):
            if not file.name.endswith(PART) and file.is_file():
                path = f"{below}/{kinds}/{file.name}"
                flights.update(flights_in(LandingFile(root, path, *folder, "acms", 0, 0)) or ())
    return sorted(day for flight in flights if (day := flight_day(flight)))
