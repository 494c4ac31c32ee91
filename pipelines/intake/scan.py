"""Register new files of the landing zone by content, so that a touched file is not a new one."""

import hashlib
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

import polars as pl

from pipelines.intake.costs import COSTS
from pipelines.intake.costs import NAME as COSTS_FILE
from pipelines.intake.findings import case_files
from pipelines.intake.landing import list_landing
from pipelines.intake.landing_file import LandingFile
from pipelines.lineage import FLIGHT_FILES
from pipelines.storage.cases import CaseLog
from pipelines.storage.ledger import FileRecord, Ledger

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
    quarantine: pl.DataFrame
    """Quarantine rows of ignored entries."""


def scan(landing: Path, ledger: Ledger) -> Scan:
    """Register new and changed files of the landing zone, with the flights of each."""
    began_ns, listing, records = time.time_ns(), list_landing(landing), ledger.file_records()
    new = _new_files(listing.files, records, ledger)
    flights = _flights([f for f in new if f.kind in FLIGHT_FILES])
    rows = [(f.path, f.operator, f.tail, _kind_of(f, flights), f.size, f.mtime_ns, _digest(f)) for f in new]
    no_files = [(p, "", "", NO_FILE, 0, 0, reason) for p, reason in listing.quarantine.select("file", "reason").rows()]
    rows += [r for r in no_files if r[0] not in records]
    own_files = [*case_files(CaseLog(ledger.home).entries()), *_settings(ledger.home, records)]
    rows += [r for r in own_files if r[0] not in records or records[r[0]].digest != r[6]]
    final = (f for f in listing.files if f.touched_ns < began_ns - TICK_NS)  # when a night reads them
    recorded_ns = {path: record.touched_ns for path, record in records.items()}
    touch_times = [(f.path, f.touched_ns) for f in final if recorded_ns.get(f.path) != f.touched_ns]
    if rows or touch_times:
        ledger.register(rows, flights, touch_times)
    new_paths = frozenset(f.path for f in new)
    return Scan(len(listing.files), len(new), sum(map(len, flights.values())), new_paths, listing.quarantine)


def _flights(files: Iterable[LandingFile]) -> dict[str, list[str]]:
    """List the flights of each file; pyarrow and the recorders' decoders are loaded only for new files."""
    if not files:
        return {}
    from pipelines.intake.snapshots import flights_in

    return {f.path: flights_in(f) for f in files}


def _settings(home: Path, records: Records) -> Iterator[Row]:
    """List the home's own settings as the ledger lists delivered files; one that was removed has no content."""
    file = home / COSTS_FILE
    if file.exists() or COSTS_FILE in records:
        yield COSTS_FILE, "", "", COSTS, 0, 0, _hash_file(file) if file.exists() else ""


def list_new_files(landing: Path, ledger: Ledger) -> tuple[int, list[LandingFile]]:
    """Count the files, and list those that are new or changed without registering them."""
    files = list_landing(landing).files
    return len(files), _new_files(files, ledger.file_records(), ledger)


def _new_files(files: Iterable[LandingFile], records: Records, ledger: Ledger) -> list[LandingFile]:
    """Select the files that are new or changed, or whose context is not the recorded one."""
    last_scan_ns = _last_scan_ns(ledger)
    current = (_with_recorded_context(file, records) for file in files)
    return [file for file in current if _is_new(file, records.get(file.path), last_scan_ns)]


def _with_recorded_context(file: LandingFile, records: Records) -> LandingFile:
    """Keep the recorded context of a file whose aircraft is not in the fleet list at present."""
    if file.in_fleet_list or file.path not in records:
        return file
    return replace(file, context=records[file.path].digest.partition(" ")[2])


def _is_new(file: LandingFile, record: FileRecord | None, last_scan_ns: int) -> bool:
    """Compare a file with its record, and its content where it was touched: a copy can keep size and time."""
    if record is None or (record.size, record.mtime_ns) != (file.size, file.mtime_ns):
        return True
    if record.digest.partition(" ")[2] != file.context:
        return True
    later = file.touched_ns > last_scan_ns if record.touched_ns is None else file.touched_ns != record.touched_ns
    return later and _digest(file) != record.digest


def _last_scan_ns(ledger: Ledger) -> int:
    """Return when the last night began, less the possible difference of two clocks; 0 where there was none."""
    nights = ledger.nights()
    if nights.is_empty():
        return 0
    return int((datetime.fromisoformat(nights["began_at"][-1]) - CLOCK_DIFFERENCE).timestamp() * 1e9)


def _kind_of(file: LandingFile, flights: dict[str, list[str]]) -> str:
    return WITHOUT_FLIGHT if file.kind in FLIGHT_FILES and not flights[file.path] else file.kind


def _digest(file: LandingFile) -> str:
    """Hash the content, empty where it cannot be read, which intake reports; with the file's context."""
    try:
        content = _hash_file(Path(file.full_path))
    except OSError:
        content = ""
    return f"{content} {file.context}" if file.context else content


def _hash_file(path: Path) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "blake2b").hexdigest()[:32]
