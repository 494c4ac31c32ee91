"""Open the ledger's tables: a SQLite file below the home, or a PostgreSQL database."""

import os
import re
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any, Self, TypeVar

import polars as pl

from pipelines.storage import postgres, sqlite_reader
from pipelines.storage.files import make_private

_SCHEMA = """
create table if not exists files (
    path text primary key, operator text not null, tail text not null, kind text not null,
    size bigint not null, mtime_ns bigint not null, digest text not null
) without rowid;
create table if not exists file_flights (
    path text not null, operator text not null, tail text not null, flight_id text not null,
    primary key (operator, tail, flight_id, path)
) without rowid;
create table if not exists done (
    asset text not null, operator text not null, tail text not null, flight_id text not null, version text not null,
    primary key (asset, operator, tail, flight_id)
) without rowid;
create table if not exists nights (
    began_at text not null, ended_at text not null, files integer not null, new_files integer not null,
    runs integer not null, cells integer not null, failed text not null
);
create table if not exists night_versions (
    night text not null, asset text not null, version bigint not null, primary key (night, asset)
) without rowid;
create table if not exists moved (
    operator text not null, tail text not null, flight_id text not null, primary key (operator, tail, flight_id)
) without rowid;
create table if not exists touched (path text primary key, touched_ns bigint not null) without rowid;
create table if not exists settled (made_as text not null);
"""
NAMES = re.findall(r"if not exists (\w+)", _SCHEMA)
FILE, HASH_FILE = "ledger.sqlite", "ledger.sealed"
MAX_FLIGHTS = 10_000  # of one query; SQLite takes 32,766 values
Result = TypeVar("Result")
_UNSETTLE = "delete from settled"


@dataclass(frozen=True)
class LedgerTables:
    """The tables of one home, or their rows of the aircraft in `only` and of the fleet, or of some `flights` of theirs.

    A `read_only` ledger writes nothing, not even an empty file or SQLite's files beside it.
    """

    home: Path
    only: tuple[tuple[str, str], ...] | None = None
    url: str = field(default_factory=lambda: os.environ.get(postgres.URL, ""), repr=False)  # may name a password
    read_only: bool = False
    flights: tuple[str, ...] | None = None

    def of(self, aircraft: Iterable[tuple[str, str]], flights: Iterable[str] | None = None) -> Self:
        """Restrict the ledger to these aircraft and the fleet: a run must not read the history of all the others.

        Of cells by flight to some `flights`, where these are given and at most `MAX_FLIGHTS`.
        """
        ids = None if flights is None else ("", *flights)
        return replace(self, only=(("", ""), *aircraft), flights=ids if ids and len(ids) <= MAX_FLIGHTS else None)

    def flush(self) -> None:
        """Move committed rows from SQLite's write-ahead log into the file itself."""
        if not self.url:
            with self._open() as con:
                con.execute("pragma wal_checkpoint(truncate)")

    @contextmanager
    def _open(self) -> Iterator[Any]:
        """Open a transaction."""
        with postgres.session(self.url, _SCHEMA.replace(" without rowid", "")) if self.url else self._file() as con:
            yield con

    @contextmanager
    def _write(self, *, settled: bool = False) -> Iterator[Any]:
        """Open a transaction that writes; unless `settled`, any cell may be stale after it."""
        if not self.url:
            (self.home / HASH_FILE).unlink(missing_ok=True)
        with self._open() as con:
            if not settled:
                con.execute(_UNSETTLE)
            yield con

    @contextmanager
    def _file(self) -> Iterator[sqlite3.Connection]:
        path = self.home / FILE
        if not path.exists():
            self.home.mkdir(parents=True, exist_ok=True)
            make_private(path)
        con = sqlite3.connect(path, timeout=60)
        try:
            con.execute("pragma journal_mode=wal")
            con.execute("pragma synchronous=full")
            con.executescript(_SCHEMA)
            with con:
                yield con
        finally:
            con.close()

    def _query(self, query: Callable[[Any], Result]) -> Result:
        """Run a query on a connection."""
        path = self.home / FILE
        if self.url or not self.read_only:
            with self._open() as con:
                return query(con)
        if path.exists():
            results = sqlite_reader.query_file(path, lambda con: [query(con)] if _has_tables(con) else [])
            if results:
                return results[0]
        with closing(sqlite3.connect(":memory:")) as con:
            con.executescript(_SCHEMA)
            return query(con)

    def _cells(self, sql: str, table: str, arguments: Iterable[str] = (), end: str = "") -> pl.DataFrame:
        """Run a query that ends in a condition, and then in `end`, restricted to the ledger's aircraft and flights."""
        if self.only is None:
            return self._frame(f"{sql} {end}", [*arguments])
        pairs = ",".join(["(?, ?)"] * len(self.only))
        aircraft = f"select * from (values {pairs}) as aircraft"  # SQLite would scan the whole fleet for bare values
        query = f"{sql} and ({table}.operator, {table}.tail) in ({aircraft})"
        flights = self.flights if self.flights is not None and table != "files" else ()
        query += f" and {table}.flight_id in ({','.join('?' * len(flights))})" if flights else ""
        return self._frame(f"{query} {end}", [*arguments, *chain.from_iterable(self.only), *flights])

    def _frame(self, sql: str, arguments: list[str]) -> pl.DataFrame:
        return self._query(lambda con: _as_frame(con.execute(sql, arguments)))


def _has_tables(con: sqlite3.Connection) -> bool:
    """Return whether all tables exist; another process may be about to create them."""
    return bool(con.execute("select name from sqlite_master where name = ?", (NAMES[-1],)).fetchall())


def _as_frame(cursor: Any) -> pl.DataFrame:
    """Fetch all rows of a cursor, counts as text."""
    names = [c[0] for c in cursor.description]
    types = {n: pl.Int64 if n in {"size", "mtime_ns"} else pl.String for n in names}
    return pl.DataFrame(cursor.fetchall(), schema=types, orient="row")
