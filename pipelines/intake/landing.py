"""What lies in the landing zone: a list of files with operator, tail and kind, and what does not belong there."""

import os
import stat
from collections.abc import Callable, Iterator
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import NamedTuple

import polars as pl

from hdt_core.components import recorded_components
from pipelines.intake.fleet_list import PACKS, FleetLines, fleet_lines
from pipelines.intake.landing_file import RECORDER, Kind, LandingFile, received
from pipelines.intake.ledger import Fault, quarantine
from pipelines.intake.names import is_operator, is_tail
from pipelines.intake.readers import ABSENT, REPORTS, TYPES, Zone, readers

PART = ".part"
MESSAGES, MAINTENANCE = "messages.csv", "maintenance.csv"


class Landing(NamedTuple):
    """The files to take in, and a quarantine row for each entry that is none."""

    files: list[LandingFile]
    quarantine: pl.DataFrame


class _Listing:
    """One walk over the zone: what it found so far."""

    def __init__(self, landing: Path) -> None:
        self.root = str(landing.resolve())
        self.files: list[LandingFile] = []
        self.faults: list[tuple[str, Fault, datetime]] = []
        self.lines = fleet_lines(landing.resolve())
        self.own = {*_KINDS, *recorded_components()}
        self.zones: dict[str, Zone] = {}

    def refuse(self, path: str, reason: str, detail: str, mtime_ns: int = 0) -> None:
        at = received(mtime_ns)
        self.faults.append((_printable(path), Fault(reason, detail=detail), at))

    def entries(self, below: str) -> Iterator[os.DirEntry[str]]:
        """Entries of a folder that may be looked at: not hidden, not still being written, not leading out."""
        try:
            found = sorted(os.scandir(f"{self.root}/{below}" if below else self.root), key=lambda e: e.name)
        except OSError as error:
            self.refuse(below, "cannot_open", error.strerror or type(error).__name__)
            return
        for entry in found:
            if PART in entry.name or entry.name.startswith(".") or (not below and entry.name == TYPES in readers()):
                continue
            if entry.is_symlink() and not self._stays_inside(entry.path):
                told = "a link that leaves the landing zone or leads nowhere"
                self.refuse(_join(below, entry.name), "outside_landing", told)
                continue
            yield entry

    def folders(self, below: str, fits: Callable[[str], bool], what: str) -> Iterator[str]:
        """Names of the folders of `below` that fit; logs that belong there are taken, everything else is refused."""
        for entry in self.entries(below):
            path = _join(below, entry.name)
            if entry.is_dir() and fits(entry.name):
                yield entry.name
            elif not self._log_file(entry, path):
                no_reader = entry.name in (RECORDER, REPORTS, TYPES)
                self.refuse(path, "unexpected_name", ABSENT if no_reader else f"not {what}")

    def take(self, entry: os.DirEntry[str], path: str, kind: Kind, judged_by: str = "") -> None:
        """Add a regular file; refuse pipes and devices, which would hang whoever opens them."""
        try:
            status = entry.stat()
        except OSError as error:
            self.refuse(path, "cannot_open", error.strerror or type(error).__name__)
            return
        if not stat.S_ISREG(status.st_mode):
            self.refuse(path, "not_a_file", "only regular files are read", status.st_mtime_ns)
            return
        operator, _, rest = path.partition("/")
        tail = rest.partition("/")[0]
        keys = ("", "") if kind in ("fleet", "type", "checks") else (operator, tail)
        times = status.st_mtime_ns, max(status.st_ctime_ns, status.st_mtime_ns)
        listed = keys == ("", "") or keys in self.lines
        self.files.append(LandingFile(self.root, path, *keys, kind, status.st_size, *times, judged_by, listed))

    def _log_file(self, entry: os.DirEntry[str], path: str) -> bool:
        """Take fleet.csv at the top and the logs of a tail, where they belong."""
        kind = _LOGS.get((path.count("/"), entry.name))
        if kind is None or entry.is_dir():
            return False
        place = path.split("/")
        self.take(entry, path, kind, judged_by(self.lines, *place) if len(place) == 3 else "")
        return True

    def is_known(self, folder: str) -> bool:
        """Whether files of a folder of an aircraft are read."""
        return folder in self.own or (folder != TYPES and folder in readers())

    def zone(self, folder: str) -> Zone:
        """The zone as the reader of a folder has it."""
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
    """All files of the contract below `landing`, sorted by path; `.part` files are not there yet and left alone.

    Per-flight files of an unusual name are listed too (their column says which flight they hold). What fits no pattern,
    leads out of the zone or is no regular file comes back as quarantine rows.
    """
    walk = _Listing(landing)
    _descriptions(walk)
    for operator in walk.folders("", is_operator, _OPERATOR):
        for tail in walk.folders(operator, is_tail, _TAIL):
            aircraft = f"{operator}/{tail}"
            for folder in walk.folders(aircraft, walk.is_known, "a file or folder of the contract"):
                _flights(walk, f"{aircraft}/{folder}", folder)
    frames = [quarantine(path, at, [fault]) for path, fault, at in walk.faults]
    return Landing(walk.files, pl.concat([quarantine("", None, []), *frames]))


def _descriptions(walk: _Listing) -> None:
    """Type descriptions of the zone; what else lies beside them are maps."""
    if not os.path.isdir(f"{walk.root}/{TYPES}") or TYPES not in readers():
        return
    faults = walk.zone(TYPES).faults
    for name, fault in faults.items():
        walk.refuse(f"{TYPES}/{name}", "bad_type", fault)
    for entry in walk.entries(TYPES):
        if entry.name.endswith(".toml") and entry.name not in faults:
            walk.take(entry, f"{TYPES}/{entry.name}", "type")


def _flights(walk: _Listing, below: str, folder: str) -> None:
    operator, tail, _ = below.split("/")
    own = "", partial(_judge, folder)
    by, judge = own if folder in walk.own else walk.zone(folder).judge(operator, tail, folder)
    told = judged_by(walk.lines, operator, tail, folder, by)
    for entry in walk.entries(below):
        path = f"{below}/{entry.name}"
        kind = judge(entry.name if entry.name.isprintable() and not entry.is_dir() else "")
        if isinstance(kind, Fault):
            walk.refuse(path, kind.reason, kind.detail)
        else:
            walk.take(entry, path, kind, told)


def judged_by(lines: FleetLines, operator: str, tail: str, place: str, by: str = "") -> str:
    """What the files of a folder of an aircraft, or its log, are judged by beside themselves, as `name=value ...`.

    It stands on record with the hash of each file, so a file is read again when this changes, and only then. What is
    as usual (two packs, listed, the default record) is not written. `by` is what the folder's reader goes by.
    """
    line, words = lines.get((operator, tail)), list[str]()
    if line and line.packs != PACKS and place != REPORTS:
        words.append(f"packs={line.packs}")
    if line and line.delivered_on and place == MAINTENANCE:
        words.append(f"delivered_on={line.delivered_on}")
    if lines and not line and place not in (MESSAGES, MAINTENANCE, REPORTS):
        words.append(f"unlisted={','.join(sorted(o for o, t in lines if t == tail))}")
    return " ".join([*words, f"by={by}"] if by else words)


_OPERATOR = "fleet.csv, checks.csv or an operator's folder: 2 to 8 capitals and digits, first a letter"
_TAIL = "an aircraft's folder: its registration, 2 to 10 capitals, digits and hyphens"
_OTHERWISE = "neither .csv nor .parquet"
_NAMED = "neither <TAIL>_<YYYYMMDD>_<LEG> nor history_<YYYY-MM>, .csv or .parquet"
_KINDS: dict[str, dict[str, Kind]] = {"acms": {"csv": "acms", "parquet": "history"}, "cpl": {"parquet": "cpl"}}
_COMPONENT: dict[str, Kind] = {"csv": "component", "parquet": "component"}


def _judge(folder: str, name: str) -> Kind | Fault:
    kind = _KINDS.get(folder, _COMPONENT).get(name.rpartition(".")[2].lower())
    return kind or Fault("unexpected_name", detail=_NAMED if folder in _KINDS else _OTHERWISE)


def _join(below: str, name: str) -> str:
    return f"{below}/{name}" if below else name


def _printable(name: str) -> str:
    """`name` without control characters and undecodable bytes, fit for a log line or a table."""
    if name.isprintable():
        return name
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in name)
