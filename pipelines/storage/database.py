"""Read and write small tables: in a SQLite file of the home or, where HDT_LEDGER_URL names one, in PostgreSQL.

SQLite itself creates two files beside one with a write-ahead log. A reader may have no right to write there, and a
read-only command must not, so a file is read without writing (`query_file`).
"""

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote

from pipelines.storage import postgres
from pipelines.storage.files import make_private

_TRIES = 20
Result = TypeVar("Result")


@dataclass(frozen=True)
class Database:
    """Tables of one schema in SQLite or, where there is a `url`, in PostgreSQL.

    `schema` creates the tables of either; `sqlite_only` are statements that PostgreSQL does without.
    """

    path: Path
    url: str = field(repr=False)  # may name a password
    schema: str
    sqlite_only: tuple[str, ...] = ()
    journal: str = "wal"

    @contextmanager
    def transaction(self, *, write: bool = True) -> Iterator[Any]:
        """Open a transaction, committed unless the block raises; in SQLite one that writes excludes other writers."""
        if self.url:
            with postgres.session(self.url, self.schema.replace(" without rowid", "")) as session:
                yield session
            return
        if not self.path.exists():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            make_private(self.path)
        with closing(sqlite3.connect(self.path, timeout=60, isolation_level=None)) as con:
            con.execute(f"pragma journal_mode={self.journal}")
            con.execute("pragma synchronous=full")
            con.execute("begin immediate" if write or not _has_tables(con) else "begin")
            with con:
                for statement in (*self.schema.split(";"), *self.sqlite_only):
                    con.execute(statement)
                yield con

    def query(self, query: Callable[[Any], Result]) -> Result:
        """Run a query without writing to a file; on empty tables where there are none yet."""
        if self.url:
            with self.transaction() as session:
                return query(session)
        if self.path.exists() and self.path.stat().st_size:  # empty: the first transaction was never committed
            results = query_file(self.path, lambda con: [query(con)] if _has_tables(con) else [])
            if results:
                return results[0]
        with closing(sqlite3.connect(":memory:")) as con:
            con.executescript(self.schema)
            return query(con)


def _has_tables(con: sqlite3.Connection) -> bool:
    return bool(con.execute("select count(*) from sqlite_master").fetchone()[0])  # one transaction makes all


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
