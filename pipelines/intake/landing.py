"""List the files of the landing zone with operator, tail and kind, and the entries that do not belong there."""

import os
import stat
from collections.abc import Callable, Iterator
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import NamedTuple

import polars as pl

from hdt_core.components import recorded_components
from pipelines.intake.faults import Fault, quarantine
from pipelines.intake.fields import is_operator, is_tail
from pipelines.intake.landing_file import RECORDER, Kind, LandingFile, modified_at
from pipelines.intake.lists import PACKS, FleetLines, fleet_lines
from pipelines.intake.readers import NO_READER, REPORTS, TYPES, Zone, readers

PART = ".part"
MESSAGES, MAINTENANCE = "messages.csv", "maintenance.csv"


class Landing(NamedTuple):
    """Files to read, and a quarantine row for each entry that is none."""

    files: list[LandingFile]
    quarantine: pl.DataFrame


class _Listing:
    """Files and faults of one walk over the zone."""

    def __init__(self, landing: Path) -> None:
        self.root = str(landing.resolve())
        self.files: list[LandingFile] = []
        self.faults: list[tuple[str, Fault, datetime]] = []
        self.lines = fleet_lines(landing.resolve())
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
            if PART in entry.name or entry.name.startswith(".") or (not below and entry.name == TYPES in readers()):
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
        times = status.st_mtime_ns, max(status.st_ctime_ns, status.st_mtime_ns)
        in_fleet_list = keys == ("", "") or keys in self.lines
        self.files.append(LandingFile(self.root, path, *keys, kind, status.st_size, *times, context, in_fleet_list))

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
    (0, "fleet.csv"): "fleet", (0, "checks.csv"): "checks", (0, "checks.parquet"): "checks",
    (2, MESSAGES): "messages", (2, MAINTENANCE): "maintenance",
}  # fmt: skip


def list_landing(landing: Path) -> Landing:
    """List all files of the contract below `landing`, sorted by path; `.part` files are incomplete and ignored.

    Per-flight files of an unusual name are listed too (their column names the flight). Entries that fit no pattern,
    lead out of the zone or are no regular file become quarantine rows.
    """
    walk = _Listing(landing)
    _descriptions(walk)
    for operator in walk.folders("", is_operator, _OPERATOR):
        for tail in walk.folders(operator, is_tail, _TAIL):
            aircraft = f"{operator}/{tail}"
            for folder in walk.folders(aircraft, walk.has_reader, "a file or folder of the contract"):
                _flights(walk, f"{aircraft}/{folder}", folder)
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


def _flights(walk: _Listing, below: str, folder: str) -> None:
    operator, tail, _ = below.split("/")
    default_reader = "", partial(_kind_of, folder)
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
    line, words = lines.get((operator, tail)), list[str]()
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


def _kind_of(folder: str, name: str) -> Kind | Fault:
    kind = _KINDS.get(folder, _COMPONENT).get(name.rpartition(".")[2].lower())
    return kind or Fault("unexpected_name", detail=_PACK_NAMES if folder in _KINDS else _COMPONENT_NAMES)


def _join(below: str, name: str) -> str:
    return f"{below}/{name}" if below else name


def _printable(name: str) -> str:
    """Replace control characters and undecodable bytes of a name, for a log line or a table."""
    if name.isprintable():
        return name
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in name)
