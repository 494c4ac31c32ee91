"""What the tables' files were when the last night ended: size, time and hash of each, so that damage is noticed.

A data file's name holds its hash already; the seal adds what can be asked without reading a file, the hashes of the
logs, and which files a table was made of. Objects have no seal: an object store keeps sums of its own.
"""

import json
import os
import zlib
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from pipelines.storage.data_file import hash_in, hash_of
from pipelines.storage.files import LOG, files_below, replacing
from pipelines.storage.store import Store

NAME = "seal.json"
CYCLE = 30
"""Nights in which each file is read once: as long as what a night replaced stays by default."""
HINT = "_last_checkpoint"  # where a log's reader may begin; it changes, and is not needed


class SealedFile(NamedTuple):
    """A file as it was."""

    size: int
    mtime_ns: int
    hash: str


class Seal(NamedTuple):
    """All files below the tables' root, and those that each table was made of."""

    files: dict[str, SealedFile]
    tables: dict[str, list[str]]


def seal(store: Store, held: Mapping[str, Iterable[str]]) -> None:
    """Note what the tables' files are, and which of them each table `held` when it was published.

    What was sealed before and is not the same now stays noted as it was.
    """
    if store.place.remote:
        return
    root, before = Path(store.place.url), read(store.home)
    known = before.files if before else {}
    there = (f for f in files_below(root) if not f.name.startswith(".") and f.name != HINT)
    files = {f.path.removeprefix(f"{root}/"): f.stat() for f in there}
    new = {n: hash_of((root / n).read_bytes()) for n, told in files.items() if not _as_before(told, known.get(n))}
    entries = {n: _entry(told, known.get(n), hash_in(n), new[n]) if n in new else known[n] for n, told in files.items()}
    _write(store.home, entries, {table: list(paths) for table, paths in held.items()})


def read(home: Path) -> Seal | None:
    """The seal of the last night; None where there is none that is whole."""
    try:
        sum_, text = (home / NAME).read_bytes().split(b"\n", 1)
    except (OSError, ValueError):
        return None
    if hash_of(text) != sum_.decode(errors="replace"):
        return None
    told = json.loads(text)
    return Seal({path: SealedFile(*entry) for path, entry in told["files"].items()}, told["tables"])


def forget(store: Store, held: Seal, paths: Collection[str], logs: Collection[str]) -> None:
    """Take files out of the seal, and the whole logs of some tables: what was wrong with them has been mended."""
    begins = tuple(f"{table}/{LOG}/" for table in logs)
    files = {path: e for path, e in held.files.items() if path not in paths and not path.startswith(begins)}
    _write(store.home, files, held.tables)


def in_turn(paths: Iterable[str], night: int) -> set[str]:
    """Files that a night reads, by its number: those read longest ago, since each has one turn in a `CYCLE`.

    A night that is stopped is not counted, so its turn comes again.
    """
    return {path for path in paths if (zlib.crc32(path.encode()) - night) % CYCLE == 0}


def changed(store: Store, held: Seal | None, paths: Iterable[str], *, whole: bool = False) -> list[str]:
    """Which of some data files, or of logs that were sealed, are missing or not what was written.

    A file whose size and time are those sealed is taken to be the same, unless all are to be read `whole`.
    """
    known = held.files if held else {}
    return [path for path in paths if not _is_same(f"{store.place.url}/{path}", path, known.get(path), whole)]


def _write(home: Path, files: dict[str, SealedFile], tables: dict[str, list[str]]) -> None:
    text = json.dumps({"files": files, "tables": tables})
    with replacing(home / NAME) as temporary:
        temporary.write_text(f"{hash_of(text.encode())}\n{text}")


def _as_before(told: os.stat_result, before: SealedFile | None) -> bool:
    return before is not None and (told.st_size, told.st_mtime_ns) == (before.size, before.mtime_ns)


def _entry(told: os.stat_result, before: SealedFile | None, named: str, found: str) -> SealedFile:
    """A file that is new or changed, whose name may hold a hash; one that is not what was written stays as it was."""
    wanted = named or (before.hash if before else "")
    if wanted and wanted != found:
        return before or SealedFile(-1, 0, wanted)
    return SealedFile(told.st_size, told.st_mtime_ns, found)


def _is_same(file: str, name: str, before: SealedFile | None, whole: bool) -> bool:
    try:
        if not whole and _as_before(os.stat(file), before):
            return True
        return hash_of(Path(file).read_bytes()) == (before.hash if before else hash_in(name))
    except OSError:
        return False


def named(lost: list[str]) -> str:
    """The first of some files and how many more there are, as the subject of a sentence."""
    return f"{lost[0]} is" if len(lost) == 1 else f"{lost[0]} and {len(lost) - 1} more are"


def is_log(path: str) -> bool:
    """Whether a file belongs to a table's log."""
    return LOG in Path(path).parts
