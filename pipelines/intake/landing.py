"""List the files of the landing zone with operator, tail and kind, and register new ones.

A file is new by its content, so that a touched one is not. Entries that do not belong there go to quarantine.
"""

import os
import stat
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import NamedTuple

import polars as pl

from hdt_core.components import recorded_components
from pipelines.intake.airframes import find_airframes, overlapping_folders, undated_folders
from pipelines.intake.faults import MAX_NAMES, Fault, quarantine
from pipelines.intake.findings import COSTS, case_files
from pipelines.intake.findings import NAME as COSTS_FILE
from pipelines.intake.landing_file import (
    PACKS,
    RECORDER,
    Aircraft,
    Kind,
    LandingFile,
    Registered,
    flight_day,
    flight_of_file,
    hash_of,
    is_operator,
    is_tail,
    modified_at,
)
from pipelines.intake.logs import FleetLines, fleet_lines
from pipelines.intake.readers import NO_READER, REPORTS, TYPES, Zone, readers
from pipelines.lineage import FLIGHT_FILES
from pipelines.storage.cases import CaseLog
from pipelines.storage.ledger import Cell, FileRecord, Ledger, Move

PART = ".part"
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
    line, words = next(iter(lines.get((operator, tail), ())), None), list[str]()
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


CLOCK_DIFFERENCE = timedelta(hours=1)
TICK_NS = 3_000_000_000
"""Coarsest change times (FAT: 2 s): a file that was read that much later is unchanged while its time is."""
Row = tuple[str, str, str, str, int, int, str]
Records = Mapping[str, FileRecord]
WITHOUT_FLIGHT = "rejected"
"""Kind of a file that should hold flights and names none: only its quarantine rows are stored."""
NO_FILE = "refused"
"""Kind of an entry of the landing zone that is no file of the contract."""


@dataclass(frozen=True, slots=True)
class Scan:
    """Files of the landing zone when it was scanned."""

    files: int
    new: int
    flights: int
    """Flights in the new files; one in two of them counts twice."""
    new_paths: frozenset[str]
    """Paths of the new files."""
    read_paths: frozenset[str]
    """Paths of the files that could be read."""
    quarantine: pl.DataFrame
    """Quarantine rows of ignored entries."""


def scan(landing: Path, ledger: Ledger) -> Scan:
    """Register new and changed files of the landing zone, with the flights of each."""
    began_ns, listing, records = time.time_ns(), list_landing(landing, ledger), ledger.file_records()
    new = _new_files(listing.files, records, ledger)
    digests = {f.path: _digest(f) for f in new}
    flights = {f.path: _flights(f, digests) for f in new if f.kind in FLIGHT_FILES}
    rows = [
        (f.path, *f.tenures[0].airframe, _kind_of(f, flights), f.size, f.mtime_ns, str(digests[f.path])) for f in new
    ]
    cells = {f.path: _cells_of(f, flights.get(f.path, [])) for f in new}
    no_files = [(p, "", "", NO_FILE, 0, 0, reason) for p, reason in listing.quarantine.select("file", "reason").rows()]
    rows += [r for r in no_files if r[0] not in records]
    own_files = [*case_files(CaseLog(ledger.home).entries()), *_settings(ledger.home, records)]
    rows += [r for r in own_files if r[0] not in records or records[r[0]].digest != r[6]]
    final = (f for f in listing.files if f.touched_ns < began_ns - TICK_NS)  # when a night reads them
    recorded_ns = {path: record.touched_ns for path, record in records.items()}
    touch_times = [(f.path, f.touched_ns) for f in final if recorded_ns.get(f.path) != f.touched_ns]
    if rows or touch_times:
        ledger.register(rows, cells, touch_times, _moves(new, records, ledger))
    new_paths = frozenset(f.path for f in new)
    read_paths = frozenset(f.path for f in listing.files if f.path not in digests or digests[f.path].content_hash)
    n_flights = sum(map(len, flights.values()))
    return Scan(len(listing.files), len(new), n_flights, new_paths, read_paths, listing.quarantine)


def find_loss(landing: Path, zone: Scan, records: Records) -> str:
    """Name the files that could be read when the zone was scanned and were not read so since; empty without any."""
    read_paths = sorted(zone.read_paths.intersection(records))
    lost = [path for path in read_paths if not Registered.parse(records[path].digest).content_hash]
    had_list = FLEET_LIST in zone.read_paths or not zone.files  # without any file the zone was unmounted before
    if had_list and not (landing / FLEET_LIST).is_file():
        lost = list(dict.fromkeys([FLEET_LIST, *lost]))
    if not lost:
        return ""
    names = ", ".join(lost[:MAX_NAMES]) + (f" and {len(lost) - MAX_NAMES} more" if len(lost) > MAX_NAMES else "")
    return f"vanished, unreadable or changed while the night ran: {names}; the next night reads what is there then"


def _flights(file: LandingFile, digests: dict[str, Registered]) -> list[str]:
    """List the flights of a new file; where it changed since it was hashed, none, and its hash goes from `digests`."""
    from pipelines.intake.snapshots import flights_in  # pyarrow and the recorders' decoders

    flights = flights_in(replace(file, content_hash=digests[file.path].content_hash))
    if flights is None:
        digests[file.path] = digests[file.path]._replace(content_hash="")
    return flights or []


def _cells_of(file: LandingFile, flights: Iterable[str]) -> list[Cell]:
    """List the flights of a file by airframe and, of a log, the further airframes that its lines belong to."""
    days = [(flight_day(flight) or date.min, flight) for flight in flights]
    tenures = [(file.tenure(day), flight) for day, flight in days]
    further = [] if file.kind in FLIGHT_FILES else file.tenures[1:]
    return [*((*t.airframe, t.prefix + flight) for t, flight in tenures), *((*t.airframe, "") for t in further)]


def _moves(files: Iterable[LandingFile], records: Records, ledger: Ledger) -> list[Move]:
    """List what is on record of files whose airframe is another now, and where it belongs."""
    changed = {f.path: f for f in files if f.path in records and f.tenures != _recorded(f, records).tenures}
    moves = []
    for path, operator, tail, flight in ledger.cells_of_files() if changed else ():
        file = changed.get(path)
        if file:
            delivered = flight.rpartition(".")[2]
            new_cell = (_cells_of(file, [delivered]) if flight else [(*file.tenures[0].airframe, "")])[0]
            if new_cell != (operator, tail, flight):
                moves.append((path, (operator, tail, flight), new_cell))
    return moves


def _recorded(file: LandingFile, records: Records) -> LandingFile:
    return replace(file, context=Registered.parse(records[file.path].digest).context)


def _flight_days(root: str, folder: Aircraft, ledger: Ledger | None) -> list[date]:
    """List the days of the flights of an operator and tail, in the landing zone and on record."""
    from pipelines.intake.snapshots import flights_in

    below = "/".join(folder)
    flights = {
        c[3].rpartition(".")[2] for c in (ledger.cells_of_files() if ledger else ()) if c[0].startswith(f"{below}/")
    }
    for kinds in _KINDS:
        for file in Path(root, below, kinds).glob("*"):
            if PART not in file.name and file.is_file():
                path = f"{below}/{kinds}/{file.name}"
                flights.update(flights_in(LandingFile(root, path, *folder, "acms", 0, 0)) or ())
    return sorted(day for flight in flights if (day := flight_day(flight)))


def _settings(home: Path, records: Records) -> Iterator[Row]:
    """List the home's own settings as the ledger lists delivered files; one that was removed has no content."""
    file = home / COSTS_FILE
    if file.exists() or COSTS_FILE in records:
        yield COSTS_FILE, "", "", COSTS, 0, 0, _hash_file(file) if file.exists() else ""


def list_new_files(landing: Path, ledger: Ledger) -> tuple[int, list[LandingFile]]:
    """Count the files, and list those that are new or changed without registering them."""
    files = list_landing(landing, ledger).files
    return len(files), _new_files(files, ledger.file_records(), ledger)


def _new_files(files: Iterable[LandingFile], records: Records, ledger: Ledger) -> list[LandingFile]:
    """Select the files that are new or changed, or whose context is not the recorded one."""
    last_scan_ns = _last_scan_ns(ledger)
    current = (_with_recorded_context(file, records) for file in files)
    now = datetime.now(UTC)
    return [file for file in current if _is_new(file, records.get(file.path), last_scan_ns, now)]


def _with_recorded_context(file: LandingFile, records: Records) -> LandingFile:
    """Keep the recorded context of a file whose aircraft is not in the fleet list at present."""
    if file.in_fleet_list or file.path not in records:
        return file
    return _recorded(file, records)


def _is_new(file: LandingFile, record: FileRecord | None, last_scan_ns: int, now: datetime) -> bool:
    """Compare a file with its record, and its content where it was touched: a copy can keep size and time.

    One that could not be read is new once it can be, and one with rows of the future when their time has come.
    """
    if record is None or (record.size, record.mtime_ns) != (file.size, file.mtime_ns):
        return True
    registered = Registered.parse(record.digest)
    if registered.context != file.context or registered.is_due(now):
        return True
    later = file.touched_ns > last_scan_ns if record.touched_ns is None else file.touched_ns != record.touched_ns
    return (later or not registered.content_hash) and _digest(file).content_hash != registered.content_hash


def _last_scan_ns(ledger: Ledger) -> int:
    """Return when the last night began, less the possible difference of two clocks; 0 where there was none."""
    nights = ledger.nights()
    if nights.is_empty():
        return 0
    return int((datetime.fromisoformat(nights["began_at"][-1]) - CLOCK_DIFFERENCE).timestamp() * 1e9)


def _kind_of(file: LandingFile, flights: Mapping[str, list[str]]) -> str:
    return WITHOUT_FLIGHT if file.kind in FLIGHT_FILES and not flights[file.path] else file.kind


def _digest(file: LandingFile) -> Registered:
    """Hash the content, empty where it cannot be read, which intake reports; with the file's context."""
    try:
        content_hash = _hash_file(Path(file.landing, file.path))
    except OSError:
        content_hash = ""
    return Registered(content_hash, "", file.context)


def _hash_file(path: Path) -> str:
    with open(path, "rb") as stream:
        return hash_of(stream)
