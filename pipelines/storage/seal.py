"""Seal the tables' files at a night's end, to notice which of them changes afterwards.

A data file's name holds its hash already; the seal adds size and time, which need no read of the file, the hashes of
the logs, and the files of each table. An object store has checks of its own.
"""

import json
import os
import zlib
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from pipelines.storage.files import LOG, files_below, hash_in, hash_of, replacing
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
