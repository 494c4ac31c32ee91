"""Scan the landing zone: find the files that are new or changed, and register them with the flights of each.

A file is new by its content, so that a touched one is not.
"""

import os
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import polars as pl

from hdt_core.loading import read_text
from pipelines.intake.faults import MAX_NAMES
from pipelines.intake.findings import COSTS, case_files
from pipelines.intake.findings import NAME as COSTS_FILE
from pipelines.intake.landing import FLEET_LIST, list_landing
from pipelines.intake.landing_file import LandingFile, Registered, flight_day, hash_of
from pipelines.lineage import FLIGHT_FILES
from pipelines.storage.cases import CaseLog
from pipelines.storage.ledger import Cell, FileRecord, Ledger, Move

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
    began_ns = time.time_ns()
    listing = list_landing(landing, ledger)
    records = ledger.file_records()
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
    unread_paths = [path for path in read_paths if not Registered.parse(records[path].digest).content_hash]
    was_unmounted = not zone.files and FLEET_LIST in records
    had_list = FLEET_LIST in zone.read_paths or was_unmounted
    if had_list and not (landing / FLEET_LIST).is_file():
        unread_paths = list(dict.fromkeys([FLEET_LIST, *unread_paths]))
    if not unread_paths:
        return ""
    n_more = len(unread_paths) - MAX_NAMES
    names = ", ".join(unread_paths[:MAX_NAMES]) + (f" and {n_more} more" if n_more > 0 else "")
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


def _settings(home: Path, records: Records) -> Iterator[Row]:
    """List the home's own settings as the ledger lists delivered files; one that was removed has no content."""
    file = home / COSTS_FILE
    if os.path.lexists(file) or COSTS_FILE in records:
        yield COSTS_FILE, "", "", COSTS, 0, 0, _hash_setting(file)


def _hash_setting(file: Path) -> str:
    """Hash a setting as it is read; one that can't be read by its fault, which the costs report."""
    try:
        return hash_of(read_text(file).encode())
    except FileNotFoundError:
        return ""
    except (ValueError, OSError) as error:
        return hash_of(str(error).encode())


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
