"""Dagster's history below a home: SQLite files that may be damaged. Nothing that was made hangs on them.

Every run has a file of its own, thousands in a year, that nobody writes once the run has ended. A night notes size and
time of those it has found sound and reads them again only when they have changed, as it does with the tables' files.
"""

import shutil
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from pipelines.storage import sqlite_reader
from pipelines.storage.files import replacing

_READ_BYTES = 256 << 20  # a larger file is not read whole by a night
_ASIDE = "dagster.damaged"
_SOUND = "sound.txt"


def fault_of(home: Path) -> str | None:
    """Which file is damaged; all are read whole."""
    return next(filter(None, (_fault_of(home, file, whole=True) for file in _files(home))), None)


def _fault_since(home: Path) -> str | None:
    """The same for a night: files that have not changed since one found them sound, or are too large, are not read."""
    note = home / "dagster" / _SOUND
    before = set(note.read_text(errors="replace").splitlines()) if note.exists() else set[str]()
    now = {_line(home, file): file for file in _files(home)}
    for line, file in now.items():
        if line not in before and (fault := _fault_of(home, file, whole=False)):
            return fault
    if before != now.keys():
        with replacing(note) as temporary:
            temporary.write_text("\n".join(now))
    return None


def _files(home: Path) -> list[Path]:
    return sorted((home / "dagster").rglob("*.db"))


def _line(home: Path, file: Path) -> str:
    """A file as it is, and the log beside it, whose pages stand for its own; a writer may take that away just now."""
    told = [str(file.relative_to(home))]
    for one in (file, file.with_name(f"{file.name}-wal")):
        with suppress(FileNotFoundError):
            told += [str(one.stat().st_size), str(one.stat().st_mtime_ns)]
    return " ".join(told)


def _fault_of(home: Path, file: Path, *, whole: bool) -> str | None:
    large = file.stat().st_size > _READ_BYTES and not whole
    said = _says(file, "select count(*) from sqlite_master" if large else "pragma quick_check(1)")
    sound = said == "ok" or (large and said.isdigit())
    return None if sound else f"{file.relative_to(home)} is damaged ({said.splitlines()[0]})"


def _says(file: Path, sql: str) -> str:
    """What a file answers; a copy of it where a log stands beside it, into which whoever reads would write."""
    log = file.with_name(f"{file.name}-wal")
    if not (log.exists() and log.stat().st_size):
        return sqlite_reader.says(file, sql)
    with TemporaryDirectory() as folder:
        for one in (file, log):
            shutil.copyfile(one, Path(folder, one.name))
        return sqlite_reader.says(Path(folder, file.name), sql)


def set_aside(home: Path, *, whole: bool = True) -> str | None:
    """Let a new history begin where the old one is damaged; what was wrong, in words.

    A night does not read it `whole`.
    """
    fault = fault_of(home) if whole else _fault_since(home)
    if fault is None:
        return None
    place = next(p for n in range(1_000_000) if not (p := home / (f"{_ASIDE}.{n}" if n else _ASIDE)).exists())
    settings = home / "dagster" / "dagster.yaml"
    kept = settings.read_bytes() if settings.exists() else None
    (home / "dagster").rename(place)
    if kept is not None:
        settings.parent.mkdir()
        settings.write_bytes(kept)
    return f"{fault}; Dagster's history begins anew, the old one is {place.name}"
