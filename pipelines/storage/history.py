"""Check Dagster's history below a home: SQLite files that may be damaged. No stored result depends on them.

Every run has a file of its own, thousands in a year, that nobody writes once the run has ended. A night notes size and
time of the files it has checked and reads them again only when they have changed, as it does with the tables' files.
"""

import shutil
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from pipelines.storage.database import query_value
from pipelines.storage.files import replacing

_READ_BYTES = 256 << 20  # a larger file is not read whole by a night
_ASIDE = "dagster.damaged"
_CHECKED = "sound.txt"


def find_history_fault(home: Path) -> str | None:
    """Find the first damaged file, reading all of them whole; the fault in words."""
    return next(filter(None, (_file_fault(home, file, whole=True) for file in _files(home))), None)


def _fault_since(home: Path) -> str | None:
    """Find the first damaged file among those that are small enough and new or changed since the last night."""
    note = home / "dagster" / _CHECKED
    old_stamps = set(note.read_text(errors="replace").splitlines()) if note.exists() else set[str]()
    files = {_stamp(home, file): file for file in _files(home)}
    for stamp, file in files.items():
        if stamp not in old_stamps and (fault := _file_fault(home, file, whole=False)):
            return fault
    if old_stamps != files.keys():
        with replacing(note) as temporary:
            temporary.write_text("\n".join(files))
    return None


def _files(home: Path) -> list[Path]:
    return sorted((home / "dagster").rglob("*.db"))


def _stamp(home: Path, file: Path) -> str:
    """Size and time of a file and of the write-ahead log beside it, which a writer may remove at any moment."""
    parts = [str(file.relative_to(home))]
    for one in (file, file.with_name(f"{file.name}-wal")):
        with suppress(FileNotFoundError):
            parts += [str(one.stat().st_size), str(one.stat().st_mtime_ns)]
    return " ".join(parts)


def _file_fault(home: Path, file: Path, *, whole: bool) -> str | None:
    large = file.stat().st_size > _READ_BYTES and not whole
    answer = _query(file, "select count(*) from sqlite_master" if large else "pragma quick_check(1)")
    intact = answer == "ok" or (large and answer.isdigit())
    return None if intact else f"{file.relative_to(home)} is damaged ({answer.splitlines()[0]})"


def _query(file: Path, sql: str) -> str:
    """Query a file, or a copy of it where there is a write-ahead log, into which a reader would write."""
    log = file.with_name(f"{file.name}-wal")
    if not (log.exists() and log.stat().st_size):
        return query_value(file, sql)
    with TemporaryDirectory() as folder:
        for one in (file, log):
            shutil.copyfile(one, Path(folder, one.name))
        return query_value(Path(folder, file.name), sql)


def replace_damaged_history(home: Path, *, whole: bool = True) -> str | None:
    """Begin a new history where the old one is damaged; the fault in words. A night does not read it `whole`."""
    fault = find_history_fault(home) if whole else _fault_since(home)
    if fault is None:
        return None
    place = next(p for n in range(1_000_000) if not (p := home / (f"{_ASIDE}.{n}" if n else _ASIDE)).exists())
    settings = home / "dagster" / "dagster.yaml"
    content = settings.read_bytes() if settings.exists() else None
    (home / "dagster").rename(place)
    if content is not None:
        settings.parent.mkdir()
        settings.write_bytes(content)
    return f"{fault}; Dagster's history begins anew, the old one is {place.name}"
