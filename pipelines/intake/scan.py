"""What is new in the landing zone, noted in the ledger by content so that a touched file is not a new one."""

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
from pipelines.storage.ledger import Ledger

APART = timedelta(hours=1)
TICK_NS = 3_000_000_000
"""Change times are no coarser than that (FAT: 2 s): a file read so much later is the same while its time stands."""
REJECTED = "rejected"  # kind of a file that should hold flights and names none: only its quarantine rows go on
Row = tuple[str, str, str, str, int, int, str]
REFUSED = "refused"  # kind of what lies in the landing zone and is no file of the contract


@dataclass(frozen=True, slots=True)
class Scan:
    """What a look at the landing zone found."""

    files: int
    new: int
    flights: int
    """Flights that the new files hold; one in two of them counts twice."""
    came: frozenset[str]
    """Paths of the new files."""
    refused: pl.DataFrame
    """What lies there and is not read, as quarantine rows."""


def scan(landing: Path, ledger: Ledger) -> Scan:
    """Register new and changed files of the landing zone, with the flights each holds."""
    began_ns, listing, seen = time.time_ns(), list_landing(landing), _Seen.of(ledger)
    new = seen.new(listing.files)
    held = _flights([f for f in new if f.kind in FLIGHT_FILES])
    rows = [(f.path, f.operator, f.tail, _kind(f, held), f.size, f.mtime_ns, _digest(f)) for f in new]
    refused = [(p, "", "", REFUSED, 0, 0, reason) for p, reason in listing.quarantine.select("file", "reason").rows()]
    rows += [r for r in refused if r[0] not in seen.known]
    told = [*case_files(CaseLog(ledger.home).entries()), *_settings(ledger.home, seen.digests)]
    rows += [r for r in told if seen.digests.get(r[0]) != r[6]]
    touched = seen.touched_since(listing.files, began_ns)
    if rows or touched:
        ledger.register(rows, held, touched)
    came = frozenset(f.path for f in new)
    return Scan(len(listing.files), len(new), sum(map(len, held.values())), came, listing.quarantine)


def _flights(files: Iterable[LandingFile]) -> dict[str, list[str]]:
    """Flights that each file holds; pyarrow and the recorders' decoders are loaded only where there is one to read."""
    if not files:
        return {}
    from pipelines.intake.snapshots import flights_in

    return {f.path: flights_in(f) for f in files}


def _settings(home: Path, digests: Mapping[str, str]) -> Iterator[Row]:
    """What the home itself declares, as the ledger knows a delivered file; one that is gone has no content."""
    file = home / COSTS_FILE
    if file.exists() or COSTS_FILE in digests:
        yield COSTS_FILE, "", "", COSTS, 0, 0, _of_content(file) if file.exists() else ""


def unseen(landing: Path, ledger: Ledger) -> tuple[int, list[LandingFile]]:
    """How many files lie there, and those that are new or changed, which are only listed."""
    files = list_landing(landing).files
    return len(files), _Seen.of(ledger).new(files)


@dataclass(frozen=True, slots=True)
class _Seen:
    """What the ledger knows of files: size and time, hash, when they were touched; and when a night last looked."""

    known: Mapping[str, tuple[int, int]]
    digests: Mapping[str, str]
    touched: Mapping[str, int]
    last_look_ns: int

    @classmethod
    def of(cls, ledger: Ledger) -> "_Seen":
        return cls(ledger.known_files(), ledger.digests(), ledger.touched(), _last_look_ns(ledger))

    def new(self, files: Iterable[LandingFile]) -> list[LandingFile]:
        """Files that are not known as they are, or were judged by something else."""
        return [f for f in map(self._as_listed, files) if self._is_new(f) or self._changed(f)]

    def _is_new(self, file: LandingFile) -> bool:
        """Whether its size, its time or what it is judged by is not what is on record."""
        if self.known.get(file.path) != (file.size, file.mtime_ns):
            return True
        return self._judged_by(file) != file.judged_by

    def _judged_by(self, file: LandingFile) -> str:
        return self.digests[file.path].partition(" ")[2]

    def _as_listed(self, file: LandingFile) -> LandingFile:
        """Of an aircraft that is not on the list tonight a file stays judged as it was."""
        if file.listed or file.path not in self.digests:
            return file
        return replace(file, judged_by=self._judged_by(file))

    def touched_since(self, files: Iterable[LandingFile], began_ns: int) -> list[tuple[str, int]]:
        """Files with a change time not on record, where a night that began then reads what will not change under it."""
        certain = ((f.path, f.touched_ns) for f in files if f.touched_ns < began_ns - TICK_NS)
        return [(path, at) for path, at in certain if self.touched.get(path) != at]

    def _changed(self, file: LandingFile) -> bool:
        """Whether a file of the same size and time is another: a copy can keep both, but not the change time."""
        before = self.touched.get(file.path)
        touched = file.touched_ns > self.last_look_ns if before is None else file.touched_ns != before
        return touched and _digest(file) != self.digests[file.path]


def _last_look_ns(ledger: Ledger) -> int:
    """When the last night began, less what clocks of two machines may be apart; 0 where there was none."""
    nights = ledger.nights()
    if nights.is_empty():
        return 0
    return int((datetime.fromisoformat(nights["began_at"][-1]) - APART).timestamp() * 1e9)


def _kind(file: LandingFile, held: dict[str, list[str]]) -> str:
    return REJECTED if file.kind in FLIGHT_FILES and not held[file.path] else file.kind


def _digest(file: LandingFile) -> str:
    """Hash of the content, empty where it cannot be read, which intake tells; and what the file is judged by."""
    try:
        content = _of_content(Path(file.full_path))
    except OSError:
        content = ""
    return f"{content} {file.judged_by}" if file.judged_by else content


def _of_content(path: Path) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "blake2b").hexdigest()[:32]
