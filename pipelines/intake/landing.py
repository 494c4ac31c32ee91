"""What lies in the landing zone: a list of files with operator, tail and kind, and what does not belong there."""

import os
import stat
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Literal, NamedTuple

import polars as pl

from hdt_core.components import recorded_components
from pipelines.intake.fleet_list import PACKS
from pipelines.intake.ledger import Fault, quarantine
from pipelines.intake.names import is_operator, is_tail
from pipelines.intake.types_of_zone import FOLDER, MAINTENANCE, MESSAGES, RECORDER, REPORTS, Types, types_of

Kind = Literal[
    "acms", "history", "cpl", "component", "recorder", "reports", "type", "messages", "maintenance", "fleet", "checks"
]
PART = ".part"
MAX_TEXT_BYTES = 64 << 20
MAX_PARQUET_BYTES = 256 << 20
"""A flight's report is kilobytes, a month of them or a 1 Hz log a few megabytes; more is refused before it is read."""


@dataclass(frozen=True, slots=True)
class LandingFile:
    """One file of the landing zone, as it was when the zone was listed."""

    landing: str
    path: str
    """Path below the landing zone, with forward slashes: how ledger and quarantine name the file."""
    operator: str
    tail: str
    kind: Kind
    size: int
    mtime_ns: int
    touched_ns: int = 0
    """When content or modification time were last set, by the file system's own clock, which no program sets back."""
    judged_by: str = ""
    """What it is judged by beside itself, see `Types.judged_by`."""
    listed: bool = True
    """Whether the fleet list has a line of its aircraft; else what is on record of a file goes on to count."""
    packs_stored: int = 0
    """Packs that are stored of it, which no line of the fleet list takes away."""

    @property
    def packs(self) -> int:
        """Packs of its aircraft."""
        return max(self.packs_listed, self.packs_stored)

    @property
    def packs_listed(self) -> int:
        """Packs by the fleet list; two where it says nothing."""
        return int(self._word("packs") or PACKS)

    @property
    def delivered_on(self) -> date | None:
        """Day on which its aircraft was delivered, of a maintenance log."""
        day = self._word("delivered_on")
        return date.fromisoformat(day) if day else None

    @property
    def unlisted(self) -> str | None:
        """None where the fleet list has the aircraft; else operators under which it has the tail."""
        return self._word("unlisted")

    def _word(self, name: str) -> str | None:
        return dict(word.split("=", 1) for word in self.judged_by.split()).get(name)

    @property
    def name(self) -> str:
        """Last part of the path."""
        return self.path.rpartition("/")[2]

    @property
    def is_text(self) -> bool:
        """Whether it is read as text and not as Parquet: its name says so, whatever became of its kind."""
        return self.path.lower().endswith(".csv")

    @property
    def source(self) -> str:
        """Where its rows come from: snapshot reports or a continuous log."""
        return "cpl" if "/cpl/" in self.path or self.is_recording else "acms"

    @property
    def is_recording(self) -> bool:
        """Whether it is a flight recorder's own file, which the type of its aircraft describes."""
        return self.folder == RECORDER

    @property
    def folder(self) -> str:
        """Folder that holds it."""
        return self.path.rpartition("/")[0].rpartition("/")[2]

    @property
    def full_path(self) -> str:
        """Where to open it."""
        return f"{self.landing}/{self.path}"

    def read(self) -> tuple[bytes | None, list[Fault]]:
        """Content, or None and the fault that kept it out."""
        limit = MAX_TEXT_BYTES if self.is_text else MAX_PARQUET_BYTES
        try:
            with open(self.full_path, "rb") as source:
                content = source.read(limit + 1)  # the size listed is that of another moment
        except OSError as error:
            return None, [Fault("cannot_open", detail=error.strerror or type(error).__name__)]
        if len(content) > limit:
            return None, [Fault("too_large", detail=f"It has more than {limit >> 20} MiB.")]
        return content, []

    @property
    def received_at(self) -> datetime:
        """When it was last written."""
        return received(self.mtime_ns)


def received(mtime_ns: int) -> datetime:
    """Modification time of a file, to the second."""
    return datetime.fromtimestamp(mtime_ns // 1_000_000_000, UTC)


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
        self.types: Types = types_of(landing.resolve())

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
            if PART in entry.name or entry.name.startswith(".") or (not below and entry.name == FOLDER):
                continue
            if entry.is_symlink() and not self._stays_inside(entry.path):
                self.refuse(
                    _join(below, entry.name), "outside_landing", "a link that leaves the landing zone or leads nowhere"
                )
                continue
            yield entry

    def folders(self, below: str, fits: Callable[[str], bool], what: str) -> Iterator[str]:
        """Names of the folders of `below` that fit; logs that belong there are taken, everything else is refused."""
        for entry in self.entries(below):
            path = _join(below, entry.name)
            if entry.is_dir() and fits(entry.name):
                yield entry.name
            elif not self._log_file(entry, path):
                self.refuse(path, "unexpected_name", f"not {what}")

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
        written, touched = status.st_mtime_ns, max(status.st_ctime_ns, status.st_mtime_ns)
        listed = keys == ("", "") or keys in self.types.lines
        self.files.append(
            LandingFile(self.root, path, *keys, kind, status.st_size, written, touched, judged_by, listed)
        )

    def _log_file(self, entry: os.DirEntry[str], path: str) -> bool:
        """Take fleet.csv at the top and the logs of a tail, where they belong."""
        kind = _LOGS.get((path.count("/"), entry.name))
        if kind is None or entry.is_dir():
            return False
        place = path.split("/")
        self.take(entry, path, kind, self.types.judged_by(*place) if len(place) == 3 else "")
        return True

    def _stays_inside(self, path: str) -> bool:
        target = os.path.realpath(path)
        return target.startswith(self.root + "/") and os.path.exists(target)


_LOGS: dict[tuple[int, str], Kind] = {
    (0, "fleet.csv"): "fleet",
    (0, "checks.csv"): "checks",
    (0, "checks.parquet"): "checks",
    (2, MESSAGES): "messages",
    (2, MAINTENANCE): "maintenance",
}


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
            known = {"acms", "cpl", RECORDER, REPORTS, *recorded_components()}
            for folder in walk.folders(aircraft, known.__contains__, "a file or folder of the contract"):
                _flights(walk, f"{aircraft}/{folder}", folder)
    frames = [quarantine(path, at, [fault]) for path, fault, at in walk.faults]
    return Landing(walk.files, pl.concat([quarantine("", None, []), *frames]))


def _descriptions(walk: _Listing) -> None:
    """Type descriptions of the zone; what else lies beside them are maps."""
    for name, fault in walk.types.faults.items():
        walk.refuse(f"{FOLDER}/{name}", "bad_type", fault)
    if not os.path.isdir(f"{walk.root}/{FOLDER}"):
        return
    for entry in walk.entries(FOLDER):
        if entry.name.endswith(".toml") and entry.name not in walk.types.faults:
            walk.take(entry, f"{FOLDER}/{entry.name}", "type")


def _flights(walk: _Listing, below: str, folder: str) -> None:
    operator, tail, _ = below.split("/")
    judged_by = walk.types.judged_by(operator, tail, folder)
    if folder == RECORDER:
        _recordings(walk, below, operator, tail, judged_by)
        return
    for entry in walk.entries(below):
        path = f"{below}/{entry.name}"
        kind = _kind(entry.name, folder)
        if kind is None or _printable(entry.name) != entry.name or entry.is_dir():
            walk.refuse(path, "unexpected_name", _EXPECTED.get(folder, _OTHERWISE))
        else:
            walk.take(entry, path, kind, judged_by)


def _recordings(walk: _Listing, below: str, operator: str, tail: str, judged_by: str) -> None:
    """Recordings of an aircraft whose type says how to read them."""
    kind, fault = walk.types.of(operator, tail), walk.types.fault_of(operator, tail)
    for entry in walk.entries(below):
        path = f"{below}/{entry.name}"
        if entry.is_dir() or _printable(entry.name) != entry.name:
            walk.refuse(path, "unexpected_name", "not a recording")
        elif kind is None or fault:
            walk.refuse(path, "unknown_type", f"{fault}.")
        else:
            walk.take(entry, path, "recorder" if kind.has_packs else "component", judged_by)


_OPERATOR = "fleet.csv, checks.csv or an operator's folder: 2 to 8 capitals and digits, first a letter"
_TAIL = "an aircraft's folder: its registration, 2 to 10 capitals, digits and hyphens"
_OTHERWISE = "neither .csv nor .parquet"
_NAMED = "neither <TAIL>_<YYYYMMDD>_<LEG> nor history_<YYYY-MM>, .csv or .parquet"
_EXPECTED = {"acms": _NAMED, "cpl": _NAMED, REPORTS: "neither .dat, .txt nor .zip"}
_KINDS: dict[str, dict[str, Kind]] = {"acms": {"csv": "acms", "parquet": "history"}, "cpl": {"parquet": "cpl"},
                                       REPORTS: dict.fromkeys(("dat", "txt", "zip"), "reports")}  # fmt: skip
_COMPONENT: dict[str, Kind] = {"csv": "component", "parquet": "component"}


def _kind(name: str, folder: str) -> Kind | None:
    return _KINDS.get(folder, _COMPONENT).get(name.rpartition(".")[2].lower())


def _join(below: str, name: str) -> str:
    return f"{below}/{name}" if below else name


def _printable(name: str) -> str:
    """`name` without control characters and undecodable bytes, fit for a log line or a table."""
    if name.isprintable():
        return name
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in name)
