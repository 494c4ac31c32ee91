"""At a night's end seal the tables' files, copy the ledger, and remove what is beyond its retention.

A data file's name holds its hash already; the seal adds size and time, which need no read of the file, the hashes of
the logs, and the files of each table. While `ledger.sealed` holds the ledger's hash nobody has written to it since, so
it must match; otherwise SQLite checks the file. The copy of the ledger, whose name holds its own hash, is that of the
last night that made something. Object stores and database servers have checks of their own.

`retention.toml` of the home declares `keep_days` (30 by default) for what a night has replaced, and `hold`, nights
(dates, or times as `hdt query --as-of` takes them) that are never removed.
"""

import json
import os
import time
import zlib
from collections.abc import Collection, Iterable, Mapping
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from deltalake import DeltaTable

from hdt_core.tables import TABLES
from pipelines.storage.database import query_value
from pipelines.storage.delta import QUIET
from pipelines.storage.files import LOG, files_below, hash_in, hash_of, make_private, replacing
from pipelines.storage.ledger import FILE, HASH_FILE, Ledger
from pipelines.storage.objects import StoreError
from pipelines.storage.settings import Retention, night_prefix, retention
from pipelines.storage.store import Store

NAME = "seal.json"
CYCLE = 30
"""Nights in which each file is read once: the default retention of replaced files."""
HINT = "_last_checkpoint"  # start of a log's reader; it changes, and is not needed


class SealedFile(NamedTuple):
    """A file at the end of a night."""

    size: int
    mtime_ns: int
    hash: str


class Seal(NamedTuple):
    """All files below the tables' root, and the current files of each table."""

    files: dict[str, SealedFile]
    tables: dict[str, list[str]]


def write_seal(store: Store, tables: Mapping[str, Iterable[str]]) -> None:
    """Seal all files, and list the published files of each table.

    A sealed file that has changed since keeps its old entry.
    """
    if store.place.remote:
        return
    root = Path(store.place.url)
    last_seal = read_seal(store.home)
    old = last_seal.files if last_seal else {}
    entries = (f for f in files_below(root) if not f.name.startswith(".") and f.name != HINT)
    stats = {f.path.removeprefix(f"{root}/"): f.stat() for f in entries}
    changed = [n for n, stat in stats.items() if not _is_unchanged(stat, old.get(n))]
    hashes = {n: (hash_in(n), hash_of((root / n).read_bytes())) for n in changed}
    files = {n: _entry(stat, old.get(n), *hashes[n]) if n in hashes else old[n] for n, stat in stats.items()}
    _write(store.home, files, {table: list(paths) for table, paths in tables.items()})


def read_seal(home: Path) -> Seal | None:
    """Read the seal of the last night; None where there is none that is whole."""
    try:
        checksum, text = (home / NAME).read_bytes().split(b"\n", 1)
    except (OSError, ValueError):
        return None
    if hash_of(text) != checksum.decode(errors="replace"):
        return None
    content = json.loads(text)
    return Seal({path: SealedFile(*entry) for path, entry in content["files"].items()}, content["tables"])


def remove_entries(store: Store, last_seal: Seal, paths: Collection[str], logs: Collection[str]) -> None:
    """Remove repaired files, and the whole logs of some tables, from the seal."""
    prefixes = tuple(f"{table}/{LOG}/" for table in logs)
    files = {path: e for path, e in last_seal.files.items() if path not in paths and not path.startswith(prefixes)}
    _write(store.home, files, last_seal.tables)


def files_to_read(paths: Iterable[str], night: int) -> set[str]:
    """Select the files that a night reads, by its number: each file once in a `CYCLE`.

    A night that is stopped is not counted, so its files are read by the next.
    """
    return {path for path in paths if (zlib.crc32(path.encode()) - night) % CYCLE == 0}


def changed_files(store: Store, last_seal: Seal | None, paths: Iterable[str], *, whole: bool = False) -> list[str]:
    """Select those of some data files or sealed logs that are missing or not what was written.

    A file with the size and time of its entry counts as unchanged, unless all are to be read `whole`.
    """
    old = last_seal.files if last_seal else {}
    return [path for path in paths if not _is_same(f"{store.place.url}/{path}", path, old.get(path), whole)]


def _write(home: Path, files: dict[str, SealedFile], tables: dict[str, list[str]]) -> None:
    text = json.dumps({"files": files, "tables": tables})
    with replacing(home / NAME) as temporary:
        temporary.write_text(f"{hash_of(text.encode())}\n{text}")


def _is_unchanged(stat: os.stat_result, old: SealedFile | None) -> bool:
    return old is not None and (stat.st_size, stat.st_mtime_ns) == (old.size, old.mtime_ns)


def _entry(stat: os.stat_result, old: SealedFile | None, hash_in_name: str, actual: str) -> SealedFile:
    """Make the entry of a new or changed file; a damaged one keeps its old entry, or gets one that never matches."""
    expected_hash = hash_in_name or (old.hash if old else "")
    if expected_hash and expected_hash != actual:
        return old or SealedFile(-1, 0, expected_hash)
    return SealedFile(stat.st_size, stat.st_mtime_ns, actual)


def _is_same(file: str, name: str, old: SealedFile | None, whole: bool) -> bool:
    try:
        if not whole and _is_unchanged(os.stat(file), old):
            return True
        return hash_of(Path(file).read_bytes()) == (old.hash if old else hash_in(name))
    except OSError:
        return False


def name_files(paths: list[str]) -> str:
    """Name the first of some files and count the others, as the subject of a sentence."""
    return f"{paths[0]} is" if len(paths) == 1 else f"{paths[0]} and {len(paths) - 1} more are"


def is_log(path: str) -> bool:
    """Return whether a file belongs to a table's log."""
    return LOG in Path(path).parts


def copy_ledger(ledger: Ledger, *, idle: bool = False) -> None:
    """Copy the ledger and write its hash; after an `idle` night an existing copy will do."""
    path = ledger.home / FILE
    hash_file = ledger.home / HASH_FILE
    if ledger.url or not path.exists():
        return
    hash_file.write_text("")  # every writer removes it; empty, after a kill, it counts as none
    ledger.flush()
    content = path.read_bytes()
    hash_ = hash_of(content)
    copy = ledger.home / f"ledger.{hash_}.copy"
    if new_copy := not (idle and _copies(ledger.home)):
        with replacing(copy) as temporary:
            make_private(temporary).write_bytes(content)
    whole = hash_file.exists()  # otherwise someone has written meanwhile
    if whole:
        _write_hash(ledger.home, hash_)
    for other in _copies(ledger.home) if new_copy else ():
        if (other != copy) == whole:
            other.unlink()


def _write_hash(home: Path, hash_: str) -> None:
    with replacing(home / HASH_FILE) as temporary:
        temporary.write_text(hash_)


def find_ledger_fault(ledger: Ledger) -> str | None:
    """Check the ledger; the fault in words, None where it is whole or where there is none yet."""
    path = ledger.home / FILE
    copies = _copies(ledger.home)
    if ledger.url or not (path.exists() or copies):
        return None
    if not path.exists():
        return "is gone"
    hash_file = ledger.home / HASH_FILE
    if hash_file.exists() and (expected_hash := hash_file.read_text(errors="replace")):
        return None if hash_of(path.read_bytes()) == expected_hash else "is not what the last night wrote"
    # SQLite's quick check takes columns of a table without rowid for empty where their order is not the key's (3.40)
    answer = query_value(path, "pragma integrity_check(1)")
    return None if answer == "ok" else f"is damaged ({answer})"


def repair_ledger(ledger: Ledger) -> str | None:
    """Replace a damaged ledger by its last copy; the fault in words."""
    fault = find_ledger_fault(ledger)
    if fault is None:
        return None
    for file in ledger.home.glob(f"{FILE}*"):
        file.unlink()
    for copy in _copies(ledger.home):
        content = copy.read_bytes()
        if hash_of(content) == _hash_in(copy):
            with replacing(ledger.home / FILE) as temporary:
                make_private(temporary).write_bytes(content)
            _write_hash(ledger.home, _hash_in(copy))
            return f"the ledger {fault}; the copy of the last night's end takes its place"
    return f"the ledger {fault}; all that lies in the landing zone is taken in again"


def _copies(home: Path) -> list[Path]:
    return sorted(home.glob("ledger.*.copy"), key=lambda copy: copy.stat().st_mtime_ns, reverse=True)


def _hash_in(copy: Path) -> str:
    return copy.name.split(".")[1]


MARKER = ".upkeep"
_EVERY_S = 20 * 3600
_LONGEST_STEP_DAYS = 30  # from one night to the next; more is a clock that jumped, or a home long at rest
_COMMITS = 20  # between two checkpoints, from which a log is read on


def remove_expired_daily(store: Store, ledger: Ledger) -> None:
    """Remove what is beyond the home's own retention, unless that was done within the day; a new home holds nothing."""
    marker = store.home / MARKER
    if not marker.exists():
        marker.touch()
    elif abs(time.time() - marker.stat().st_mtime) >= _EVERY_S:  # a clock may have been ahead
        remove_expired(store, ledger, retention(store.home))
        marker.touch()


def remove_expired(store: Store, ledger: Ledger, policy: Retention) -> None:
    """Delete nights beyond their retention but the last, and the files that no night on record needs.

    Nothing goes where the clock has jumped within the last `CYCLE` nights: by a wrong one every night is too old.
    """
    nights = ledger.snapshots()
    if has_jumped([*nights][-CYCLE:], max(policy.keep_days, _LONGEST_STEP_DAYS)):
        return
    first = (datetime.now(UTC) - timedelta(days=policy.keep_days)).isoformat()
    protected_nights = {
        find_night(nights, night)[0] for night in policy.hold if any(n[: len(night)] <= night for n in nights)
    }
    replaced = [*nights][:-1]
    ledger.delete_nights([name for name in replaced if name < first and name not in protected_nights])
    for table in TABLES:
        versions = [nights[name][table] for name in protected_nights if name < first and table in nights[name]]
        if (log := store.tables.open(table)) is not None:
            _vacuum(store, table, log, policy.keep_days, versions)


def has_jumped(nights: Iterable[str], longest_days: float) -> bool:
    """Return whether the clock went back, or on by more than so many days, from one night to the next or to now."""
    times = [datetime.fromisoformat(night.partition("#")[0]) for night in nights]
    steps = pairwise([*times, datetime.now(UTC)])
    return any(not timedelta() <= after - before <= timedelta(days=longest_days) for before, after in steps)


def _vacuum(store: Store, table: str, log: DeltaTable, keep_days: int, protected_versions: list[int]) -> None:
    """Vacuum a table, and shorten its log unless an old night is protected."""
    hours = 24 * keep_days
    if log.vacuum(hours, enforce_retention_duration=False, full=True, keep_versions=protected_versions or None):
        log.vacuum(
            hours, False, False, full=True, keep_versions=protected_versions or None, post_commithook_properties=QUIET
        )
        log.update_incremental()
    if log.version() - _checkpoint(store, table) >= _COMMITS:
        log.create_checkpoint()
        if not protected_versions:
            log.cleanup_metadata()
    store.place.sync_commit(table, log.version())


def _checkpoint(store: Store, table: str) -> int:
    try:
        return int(json.loads(store.place.get(f"{table}/{LOG}/_last_checkpoint"))["version"])
    except (OSError, ValueError, KeyError):
        return 0


def find_night(nights: dict[str, dict[str, int]], night: str) -> tuple[str, dict[str, int]]:
    """Find the last night at or before a date or time, or the first part of one, and its versions of the tables."""
    if night in nights:
        return night, nights[night]
    prefix = night_prefix(night.partition("#")[0])
    if prefix is None:
        raise StoreError(f"give a day (2024-06-19) or a time in UTC (2024-06-19T04:30), not {night}")
    earlier = [name for name in nights if name[: len(prefix)] <= prefix]
    if not earlier:
        first = f"the first on record is {min(nights).partition('#')[0]}" if nights else "none is on record"
        raise StoreError(f"no night at or before {night!r}; {first}")
    return earlier[-1], nights[earlier[-1]]
