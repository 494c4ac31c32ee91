"""Read a SQLite file without writing: SQLite itself creates two files beside one with a write-ahead log.

The reader may have no right to write there, and a read-only command must not.
"""

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TypeVar
from urllib.parse import quote

_TRIES = 20
Result = TypeVar("Result")


def query_file(path: Path, query: Callable[[sqlite3.Connection], Result]) -> Result:
    """Run a query on the file.

    A log beside it means that a writer is at work or was killed: SQLite shares its files. Otherwise the file is opened
    as immutable, and again if it has changed meanwhile.
    """
    for _ in range(_TRIES):
        before = _stamp(path)
        if before[2]:
            break
        try:
            result = _run(path, "immutable=1", query)
        except sqlite3.DatabaseError:
            if _stamp(path) == before:
                raise
            continue
        if _stamp(path) == before:
            return result
    return _run(path, "mode=ro", query)


def query_value(path: Path, sql: str) -> str:
    """Run a statement that answers one value; the value or the error as text of one line."""
    try:
        return str(query_file(path, lambda con: con.execute(sql).fetchone()[0])).splitlines()[0]
    except sqlite3.DatabaseError as error:
        return str(error).splitlines()[0]


def _run(path: Path, mode: str, query: Callable[[sqlite3.Connection], Result]) -> Result:
    with closing(sqlite3.connect(f"file:{quote(str(path.resolve()))}?{mode}", uri=True, timeout=60)) as con:
        return query(con)


def _stamp(path: Path) -> tuple[int, int, bool]:
    """Return size and time, which change with every commit, and whether a writer's log is in use."""
    stat, log = path.stat(), path.with_name(f"{path.name}-wal")
    try:
        log_in_use = log.stat().st_size > 0
    except FileNotFoundError:  # none, or its writer has just removed it
        log_in_use = False
    return stat.st_size, stat.st_mtime_ns, log_in_use
