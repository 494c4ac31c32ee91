"""What is new in the landing zone, noted in the ledger by content so that a touched file is not a new one."""

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from pipelines.intake.costs import COSTS
from pipelines.intake.costs import NAME as COSTS_FILE
from pipelines.intake.findings import case_files
from pipelines.intake.landing import LandingFile, list_landing
from pipelines.intake.types_of_zone import read_by
from pipelines.lineage import FLIGHT_FILES
from pipelines.storage.cases import CaseLog
from pipelines.storage.ledger import Ledger

APART = timedelta(hours=1)
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


def scan(landing: Path, ledger: Ledger) -> Scan:
    """Register new and changed files of the landing zone, with the flights each holds."""
    listing = list_landing(landing)
    known, digests = ledger.known_files(), ledger.digests()
    new = _new(listing.files, known, digests, _last_look_ns(ledger))
    held = _flights([f for f in new if f.kind in FLIGHT_FILES])
    rows = [(f.path, f.operator, f.tail, _kind(f, held), f.size, f.mtime_ns, _digest(f)) for f in new]
    refused = [(p, "", "", REFUSED, 0, 0, reason) for p, reason in listing.quarantine.select("file", "reason").rows()]
    rows += [r for r in refused if r[0] not in known]
    told = [*case_files(CaseLog(ledger.home).entries()), *_settings(ledger.home, digests)]
    rows += [r for r in told if digests.get(r[0]) != r[6]]
    if rows:
        ledger.register(rows, held)
    return Scan(len(listing.files), len(new), sum(map(len, held.values())))


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
    return len(files), _new(files, ledger.known_files(), ledger.digests(), _last_look_ns(ledger))


def _new(
    files: Iterable[LandingFile], known: Mapping[str, tuple[int, int]], digests: Mapping[str, str], since_ns: int
) -> list[LandingFile]:
    """Files that are not known as they are; of those touched since the last night the content is compared too."""
    return [f for f in files if known.get(f.path) != (f.size, f.mtime_ns) or _changed(f, since_ns, digests)]


def _changed(file: LandingFile, since_ns: int, digests: Mapping[str, str]) -> bool:
    """Whether a file of the same size and time is another: an editor or a copy can keep both."""
    return file.touched_ns > since_ns and _digest(file) != digests[file.path]


def _last_look_ns(ledger: Ledger) -> int:
    """When the last night began, less what clocks of two machines may be apart; 0 where there was none."""
    nights = ledger.nights()
    if nights.is_empty():
        return 0
    return int((datetime.fromisoformat(nights["began_at"][-1]) - APART).timestamp() * 1e9)


def _kind(file: LandingFile, held: dict[str, list[str]]) -> str:
    return REJECTED if file.kind in FLIGHT_FILES and not held[file.path] else file.kind


def _digest(file: LandingFile) -> str:
    """Hash of the content, and of what a recording is read by; empty where it cannot be read, which intake tells."""
    also = read_by(Path(file.landing), file.operator, file.tail, file.folder)
    try:
        digests = [_of_content(path) for path in (Path(file.full_path), *also)]
    except OSError:
        return ""
    return digests[0] if len(digests) == 1 else hashlib.blake2b(" ".join(digests).encode()).hexdigest()[:32]


def _of_content(path: Path) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "blake2b").hexdigest()[:32]
