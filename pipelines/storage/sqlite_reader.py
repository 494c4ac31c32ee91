"""Reads of a SQLite file that leave no trace: SQLite itself would make two files beside one that keeps a log.

Whoever reads may not be able to write there, and a command that only looks must not.
"""

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TypeVar
from urllib.parse import quote

_TRIES = 20
Answer = TypeVar("Answer")


def read(path: Path, ask: Callable[[sqlite3.Connection], Answer]) -> Answer:
    """What `ask` finds in the file.

    Where a log stands beside it a writer is at work, or was killed: its files are there and SQLite shares them. Else
    the file is read as one that does not change, and again if it did.
    """
    for _ in range(_TRIES):
        before = _stamp(path)
        if before[2]:
            break
        try:
            answer = _asked(path, "immutable=1", ask)
        except sqlite3.DatabaseError:
            if _stamp(path) == before:
                raise
            continue
        if _stamp(path) == before:
            return answer
    return _asked(path, "mode=ro", ask)


def says(path: Path, sql: str) -> str:
    """The one value that a statement answers, or why there is none, as a text of one line."""
    try:
        return str(read(path, lambda con: con.execute(sql).fetchone()[0])).splitlines()[0]
    except sqlite3.DatabaseError as error:
        return str(error).splitlines()[0]


def _asked(path: Path, how: str, ask: Callable[[sqlite3.Connection], Answer]) -> Answer:
    with closing(sqlite3.connect(f"file:{quote(str(path.resolve()))}?{how}", uri=True, timeout=60)) as con:
        return ask(con)


def _stamp(path: Path) -> tuple[int, int, bool]:
    """Size and time, which change with every commit, and whether a writer's log stands beside the file."""
    told, log = path.stat(), path.with_name(f"{path.name}-wal")
    try:
        logged = log.stat().st_size > 0
    except FileNotFoundError:  # none, or its writer took it away just now
        logged = False
    return told.st_size, told.st_mtime_ns, logged
