"""Check Dagster's history below a home: SQLite files that may be damaged. No stored result depends on them.

Every run has a file of its own, thousands in a year, that nobody writes once the run has ended: `hdt doctor` and `hdt
tidy` read these too, a night those that all runs share.
"""

import re
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

from pipelines.storage.database import query_value

_READ_BYTES = 256 << 20  # a larger file is not read whole by a night
_ASIDE = "dagster.damaged"
_RUN_ID = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")


def find_history_fault(home: Path, *, whole: bool = True) -> str | None:
    """Find the first damaged file of all, each read whole, or of those that all runs share; the fault in words."""
    files = (f for f in sorted((home / "dagster").rglob("*.db")) if whole or not _RUN_ID.fullmatch(f.stem))
    return next(filter(None, (_file_fault(home, file, whole=whole) for file in files)), None)


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
    fault = find_history_fault(home, whole=whole)
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
