"""What was delivered and what was made of it: small tables in `<home>/ledger.sqlite`.

Where HDT_LEDGER_URL names a PostgreSQL database they are there instead, and several machines may work for one fleet.
`files` says which file holds which flights, by content hash, `touched` which of them were read long enough after they
were last touched to be the same while that time stands; `done` says of which inputs each stored cell was made. A
cell is stale when the two disagree. Data are synced to disk before their line in `done` is committed, so a kill at any
moment costs work, never truth. `night_versions` says which version of each table a night published. `nights` says when
the chain last ran, and what failed; `settled`, until something is noted, that nothing was stale after it: an idle night
need not look at every cell.
"""

import os
import re
import sqlite3
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import polars as pl

from pipelines.storage import postgres, sqlite_reader

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
_COLUMNS = "path, operator, tail, kind, digest, size, mtime_ns"
_SET_FILE = (
    "insert into files values (?, ?, ?, ?, ?, ?, ?) on conflict (path) do update set operator = excluded.operator,"
    " tail = excluded.tail, kind = excluded.kind, size = excluded.size, mtime_ns = excluded.mtime_ns,"
    " digest = excluded.digest"
)
_SET_TOUCHED = "insert into touched values (?, ?) on conflict (path) do update set touched_ns = excluded.touched_ns"
_SET_VERSION = (
    "insert into done values (?, ?, ?, ?, ?)"
    " on conflict (asset, operator, tail, flight_id) do update set version = excluded.version"
)
FILE, SEALED = "ledger.sqlite", "ledger.sealed"
MOST_NAMED = 10_000  # flights in one question; SQLite takes 32,766 values
Answer = TypeVar("Answer")
_UNSETTLE = "delete from settled"


@dataclass(frozen=True)
class Ledger:
    """The ledger of one home, or what it says `only` of some aircraft, or some `flights` of theirs, and of the fleet.

    Who only `looks` writes nothing, not even an empty ledger or SQLite's files beside it.
    """

    home: Path
    only: tuple[tuple[str, str], ...] | None = None
    url: str = field(default_factory=lambda: os.environ.get(postgres.URL, ""), repr=False)  # may name a password
    looks: bool = False
    flights: tuple[str, ...] | None = None

    def of(self, aircraft: Iterable[tuple[str, str]], flights: Iterable[str] | None = None) -> "Ledger":
        """What it says of these aircraft and of the fleet: a run must not read the history of all the others.

        Of cells by flight only those of some `flights`, where these are given and few enough to be named.
        """
        named = None if flights is None else ("", *flights)
        return replace(
            self, only=(("", ""), *aircraft), flights=named and (named if len(named) <= MOST_NAMED else None)
        )

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
        con = sqlite3.connect(self.home / FILE, timeout=60)
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

    def known_files(self) -> dict[str, tuple[int, int]]:
        """Size and modification time of every file seen, by path."""
        rows = self._ask(lambda con: con.execute("select path, size, mtime_ns from files").fetchall())
        return {path: (size, mtime_ns) for path, size, mtime_ns in rows}

    def digests(self) -> dict[str, str]:
        """Content hash of every file seen, by path."""
        return dict(self._ask(lambda con: con.execute("select path, digest from files").fetchall()))

    def touched(self) -> dict[str, int]:
        """When each file was last touched, by path, of those that were read long enough after that."""
        asked = (
            "select path, touched_ns from touched"  # a home of an earlier version, only looked at, has no such table
        )
        return dict(self._ask(lambda con: con.execute(asked).fetchall() if self.url or _has(con, "touched") else []))

    def register(
        self,
        files: Iterable[tuple[str, str, str, str, int, int, str]],
        flights: dict[str, list[str]],
        touched: Iterable[tuple[str, int]] = (),
    ) -> None:
        """Note new or changed files (path, operator, tail, kind, size, mtime_ns, digest) and the flights each holds.

        And when files were last `touched` (path, time in ns).

        A flight that a replaced file no longer holds stays with it: what was stored of it is kept, and accounted for
        even where a killed night had stored its rows and no more.
        """
        rows = list(files)
        with self._write(settled=True) as con:
            con.executemany(_SET_FILE, rows)
            con.executemany(_SET_TOUCHED, list(touched))
            held = [(r[0], r[1], r[2], f) for r in rows for f in flights.get(r[0], [])]
            con.executemany("insert into file_flights values (?, ?, ?, ?) on conflict do nothing", held)
            if con.execute("select made_as from settled").fetchall():  # else any cell may be stale
                moved = {(r[1], r[2], f) for r in rows for f in ("", *flights.get(r[0], []))}
                con.executemany("insert into moved values (?, ?, ?) on conflict do nothing", sorted(moved))
            sys.audit("hdt.before_register")
        sys.audit("hdt.after_register")

    def files(self, kinds: Iterable[str]) -> pl.DataFrame:
        """Files of some kinds: path, operator, tail, kind, digest, size, mtime_ns."""
        kinds = list(kinds)
        marks = ",".join("?" * len(kinds)) or "null"  # PostgreSQL knows no empty list
        return self._cells(f"select {_COLUMNS} from files where kind in ({marks})", "files", kinds)

    def flight_files(self) -> pl.DataFrame:
        """Which file holds which flight: operator, tail, flight_id, path, digest, kind, size, mtime_ns."""
        columns = "l.operator, l.tail, l.flight_id, l.path, f.digest, f.kind, f.size, f.mtime_ns"
        return self._cells(f"select {columns} from file_flights l join files f using (path) where true", "l")

    def holdings(self) -> pl.DataFrame:
        """What each flight is made of, a row a file that holds it: operator, tail, flight_id, line (path=digest)."""
        columns = "l.operator, l.tail, l.flight_id, l.path || '=' || f.digest as line"
        return self._cells(f"select {columns} from file_flights l join files f using (path) where true", "l")

    def done(self, asset: str) -> pl.DataFrame:
        """Stored cells of an asset: operator, tail, flight_id (empty above flights), version."""
        return self._cells("select operator, tail, flight_id, version from done where asset = ?", "done", [asset])

    def lines(self, asset: str) -> pl.DataFrame:
        """Of each aircraft all stored cells of an asset as one text: operator, tail, lines.

        A cell's line is `operator=tail=flight_id=version`; they stand in no order, parted by `|`. The database joins
        them, for a row a flight would take twice as long.
        """
        fold = "string_agg" if self.url else "group_concat"
        line = "operator || '=' || tail || '=' || flight_id || '=' || version"
        asked = f"select operator, tail, {fold}({line}, '|') as lines from done where asset = ?"
        return self._cells(asked, "done", [asset], "group by operator, tail")

    def mark(self, asset: str, cells: pl.DataFrame) -> None:
        """Note that cells (operator, tail, flight_id, version) of an asset are stored and synced to disk."""
        wanted = cells.select(pl.lit(asset).alias("asset"), "operator", "tail", "flight_id", "version")
        rows = sorted(wanted.rows(), key=lambda row: row[:4])  # in one order, or two who mark the same cells deadlock
        with self._write() as con:
            con.executemany(_SET_VERSION, rows)
            sys.audit("hdt.before_mark")
        sys.audit("hdt.after_mark")

    def settle(self, made_as: str) -> None:
        """Note that nothing is stale where cells are made in this way."""
        with self._write() as con:
            con.execute("delete from moved")
            con.execute("insert into settled values (?)", (made_as,))

    def settled_as(self) -> str | None:
        """How cells were made when nothing was stale but what has `moved` since; None where any cell may be."""
        rows = self._ask(lambda con: con.execute("select made_as from settled").fetchall())
        return str(rows[0][0]) if len(rows) == 1 else None

    def moved(self) -> pl.DataFrame:
        """Cells whose files came since it was settled: operator, tail, flight_id (empty for files without flights)."""
        return self._frame("select operator, tail, flight_id from moved", [])

    def is_settled(self, made_as: str) -> bool:
        """Whether nothing is stale where cells are made in this way."""
        return self.settled_as() == made_as and self.moved().is_empty()

    def flown(self) -> pl.DataFrame:
        """Flights that some file holds: operator, tail, flight_id."""
        return self._cells("select distinct operator, tail, flight_id from file_flights where true", "file_flights")

    def note_night(self, row: tuple[str, str, int, int, int, int, str]) -> None:
        """Note that a night ended: began_at, ended_at, files, new_files, runs, cells, failed (JSON)."""
        with self._write(settled=True) as con:
            con.execute("insert into nights values (?, ?, ?, ?, ?, ?, ?)", row)

    def nights(self) -> pl.DataFrame:
        """All nights, oldest first, counts as text."""
        return self._frame(f"select * from nights order by {'ctid' if self.url else 'rowid'}", [])

    def note_snapshot(self, versions: dict[str, int]) -> None:
        """Note which version of each table is published now."""
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        with self._write(settled=True) as con:
            con.executemany("insert into night_versions values (?, ?, ?)", [(now, *row) for row in versions.items()])

    def snapshots(self) -> dict[str, dict[str, int]]:
        """Versions of the tables that each night published, oldest first."""
        found: dict[str, dict[str, int]] = {}
        rows = self._ask(lambda con: con.execute("select night, asset, version from night_versions").fetchall())
        for night, asset, version in sorted(rows):
            found.setdefault(night, {})[asset] = version
        return found

    def forget(
        self, assets: Iterable[str], aircraft: tuple[str, str] | None = None, flights: Iterable[str] | None = None
    ) -> None:
        """Note that cells are not stored any more: of all or one aircraft, all or some of its flights."""
        only = "" if aircraft is None else " and operator = ? and tail = ?"
        only += "" if flights is None else " and flight_id = ?"
        ids = [()] if flights is None else [(flight,) for flight in flights]
        rows = [(asset, *(aircraft or ()), *flight) for asset in assets for flight in ids]
        with self._write() as con:
            con.executemany(f"delete from done where asset = ?{only}", rows)

    def forget_nights(self, nights: Iterable[str]) -> None:
        """Forget what some nights published."""
        rows = [(night,) for night in nights]
        if rows:
            with self._write(settled=True) as con:
                con.executemany("delete from night_versions where night = ?", rows)

    def forget_snapshots(self, asset: str) -> None:
        """Note that earlier versions of a table are lost."""
        with self._write() as con:
            con.execute("delete from night_versions where asset = ?", [asset])

    def flush(self) -> None:
        """Bring what was committed into the file itself; of a database server nothing is asked."""
        if not self.url:
            with self._open() as con:
                con.execute("pragma wal_checkpoint(truncate)")

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
    return _has(con, NAMES[-1])


def _has(con: sqlite3.Connection, table: str) -> bool:
    return bool(con.execute("select name from sqlite_master where name = ?", (table,)).fetchall())


def _as_frame(cursor: Any) -> pl.DataFrame:
    """All rows of a cursor, counts as text."""
    names = [c[0] for c in cursor.description]
    types = {n: pl.Int64 if n in {"size", "mtime_ns"} else pl.String for n in names}
    return pl.DataFrame(cursor.fetchall(), schema=types, orient="row")
