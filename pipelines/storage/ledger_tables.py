"""The ledger's tables and how they are reached: a SQLite file below the home, or a PostgreSQL database."""

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
from pipelines.storage.files import private

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
FILE, SEALED = "ledger.sqlite", "ledger.sealed"
MOST_NAMED = 10_000  # flights in one question; SQLite takes 32,766 values
Answer = TypeVar("Answer")
_UNSETTLE = "delete from settled"


@dataclass(frozen=True)
class LedgerTables:
    """The tables of one home, or what they say `only` of some aircraft, or some `flights` of theirs, and of the fleet.

    Who only `looks` writes nothing, not even an empty ledger or SQLite's files beside it.
    """

    home: Path
    only: tuple[tuple[str, str], ...] | None = None
    url: str = field(default_factory=lambda: os.environ.get(postgres.URL, ""), repr=False)  # may name a password
    looks: bool = False
    flights: tuple[str, ...] | None = None

    def of(self, aircraft: Iterable[tuple[str, str]], flights: Iterable[str] | None = None) -> Self:
        """What it says of these aircraft and of the fleet: a run must not read the history of all the others.

        Of cells by flight only those of some `flights`, where these are given and few enough to be named.
        """
        named = None if flights is None else ("", *flights)
        return replace(
            self, only=(("", ""), *aircraft), flights=named and (named if len(named) <= MOST_NAMED else None)
        )

    def flush(self) -> None:
        """Bring what was committed into the file itself; of a database server nothing is asked."""
        if not self.url:
            with self._open() as con:
                con.execute("pragma wal_checkpoint(truncate)")

    @contextmanager
    def _open(self) -> Iterator[Any]:
        """A transaction."""
        with postgres.session(self.url, _SCHEMA.replace(" without rowid", "")) if self.url else self._file() as con:
            yield con

    @contextmanager
    def _write(self, *, settled: bool = False) -> Iterator[Any]:
        """A transaction that changes something; what was `settled` may not be any more."""
        if not self.url:
            (self.home / SEALED).unlink(missing_ok=True)
        with self._open() as con:
            if not settled:
                con.execute(_UNSETTLE)
            yield con

    @contextmanager
    def _file(self) -> Iterator[sqlite3.Connection]:
        self.home.mkdir(parents=True, exist_ok=True)
        con = sqlite3.connect(private(self.home / FILE), timeout=60)
        try:
            con.execute("pragma journal_mode=wal")
            con.execute("pragma synchronous=full")
            con.executescript(_SCHEMA)
            with con:
                yield con
        finally:
            con.close()

    def _ask(self, ask: Callable[[Any], Answer]) -> Answer:
        """What `ask` finds through a connection."""
        path = self.home / FILE
        if self.url or not self.looks:
            with self._open() as con:
                return ask(con)
        found = sqlite_reader.read(path, lambda con: (ask(con),) if _is_made(con) else ()) if path.exists() else ()
        if found:
            return found[0]
        with closing(sqlite3.connect(":memory:")) as con:
            con.executescript(_SCHEMA)
            return ask(con)

    def _cells(self, sql: str, table: str, arguments: Iterable[str] = (), end: str = "") -> pl.DataFrame:
        """Rows of a query that ends in a condition, and then in `end`, of the aircraft that it is about."""
        if self.only is None:
            return self._frame(f"{sql} {end}", [*arguments])
        pairs = ",".join(["(?, ?)"] * len(self.only))
        asked = f"select * from (values {pairs}) as asked"  # not the bare values: SQLite would walk the whole fleet
        within = f"{sql} and ({table}.operator, {table}.tail) in ({asked})"
        flights = self.flights if self.flights is not None and table != "files" else ()
        within += f" and {table}.flight_id in ({','.join('?' * len(flights))})" if flights else ""
        return self._frame(f"{within} {end}", [*arguments, *chain.from_iterable(self.only), *flights])

    def _frame(self, sql: str, arguments: list[str]) -> pl.DataFrame:
        return self._ask(lambda con: _as_frame(con.execute(sql, arguments)))


def _is_made(con: sqlite3.Connection) -> bool:
    """Whether the tables are there: who makes the file is not done at once."""
    return bool(con.execute("select name from sqlite_master where name = ?", (NAMES[-1],)).fetchall())


def _as_frame(cursor: Any) -> pl.DataFrame:
    """All rows of a cursor, counts as text."""
    names = [c[0] for c in cursor.description]
    types = {n: pl.Int64 if n in {"size", "mtime_ns"} else pl.String for n in names}
    return pl.DataFrame(cursor.fetchall(), schema=types, orient="row")
