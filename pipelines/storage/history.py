"""Dagster's history below a home: SQLite files that may be damaged. Nothing that was made hangs on them."""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

from pipelines.storage import sqlite_reader

_READ_BYTES = 256 << 20  # a larger file is not read whole by a night
_ASIDE = "dagster.damaged"


def fault_of(home: Path, *, whole: bool = True) -> str | None:
    """Which file is damaged; files too large for a night only where all are to be read `whole`."""
    for file in sorted((home / "dagster").rglob("*.db")):
        large = file.stat().st_size > _READ_BYTES and not whole
        asked = "select count(*) from sqlite_master" if large else "pragma quick_check(1)"
        said = _says(file, asked)
        if not (said == "ok" or (large and said.isdigit())):
            return f"{file.relative_to(home)} is damaged ({said.splitlines()[0]})"
    return None


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
    """Let a new history begin where the old one is damaged; what was wrong, in words."""
    fault = fault_of(home, whole=whole)
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
