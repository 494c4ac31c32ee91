"""Keep account of delivered files and of the cells made from them: small tables in `<home>/ledger.sqlite`.

Where HDT_LEDGER_URL names a PostgreSQL database they are there instead, and several machines may work for one fleet.
`files` and `file_flights` list the flights of each file and its content hash; `done` holds the version of the inputs
of each stored cell. A cell is stale when the two disagree. Data are synced to disk before their row in `done` is
committed, so a kill at any moment costs work, never truth. `touched` holds the time of last change of files that have
been read since: a file with that time is unchanged. `night_versions` holds the version of each table that a night
published, `nights` when the chain ran and what failed. A row in `settled` means that no cell was stale when it was
written, and none is since but those in `moved`: an idle night need not check every cell.
"""

import os
import re
import sqlite3
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import chain, starmap
from pathlib import Path
from typing import Any, NamedTuple, Self

import polars as pl

from pipelines.storage.database import URL, Database, Result, turn

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
_NUMBERS = ("size", "mtime_ns")
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


Cell = tuple[str, str, str]
"""Operator and tail of an airframe's key, and a flight of it; empty above flights."""
Move = tuple[str, Cell, Cell]
"""A file, a cell that it was registered for, and the one that it belongs to now."""
_Query = tuple[str, list[str]]
"""SQL and its arguments."""


class FileRecord(NamedTuple):
    """A file as it was registered; `touched_ns` only if it was read long enough after it was last touched."""

    size: int
    mtime_ns: int
    digest: str
    touched_ns: int | None


@dataclass(frozen=True)
class Ledger:
    """The ledger of one home, or its rows of the aircraft in `only` and of the fleet, or of some `flights` of theirs.

    A `read_only` ledger writes nothing, not even an empty file or SQLite's files beside it.
    """

    home: Path
    only: tuple[tuple[str, str], ...] | None = None
    url: str = field(default_factory=lambda: os.environ.get(URL, ""), repr=False)  # may name a password
    read_only: bool = False
    flights: tuple[str, ...] | None = None

    def of(self, aircraft: Iterable[tuple[str, str]], flights: Iterable[str] | None = None) -> Self:
        """Restrict the ledger to these aircraft and the fleet: a run must not read the history of all the others.

        Of cells by flight to some `flights`, where these are given and at most `MAX_FLIGHTS`.
        """
        ids = None if flights is None else ("", *flights)
        return replace(self, only=(("", ""), *aircraft), flights=ids if ids and len(ids) <= MAX_FLIGHTS else None)

    @property
    def _database(self) -> Database:
        return Database(self.home / FILE, self.url, _SCHEMA)

    def flush(self) -> None:
        """Move committed rows from SQLite's write-ahead log into the file itself."""
        if not self.url:
            with closing(sqlite3.connect(self.home / FILE, timeout=60)) as con:
                con.execute("pragma wal_checkpoint(truncate)")

    def turn(self, *, shared: bool) -> AbstractContextManager[None]:
        """Wait for the turn to store and mark: beside others whose turn is `shared`, or alone."""
        return turn(self.home / ".storing", self.url, shared=shared)

    def _write(self, *, settled: bool = False) -> AbstractContextManager[Any]:
        """Open a transaction that writes; unless `settled`, any cell may be stale after it."""
        if not self.url:
            (self.home / HASH_FILE).unlink(missing_ok=True)
        return self._database.transaction("" if settled else "delete from settled")

    def _query(self, query: Callable[[Any], Result]) -> Result:
        """Run a query on a connection."""
        if self.read_only:
            return self._database.query(query)
        with self._database.transaction(write=False) as con:
            return query(con)

    def _restricted(self, sql: str, table: str, arguments: Iterable[str], end: str = "") -> _Query:
        """Restrict a query that ends in a condition, and then in `end`, to the ledger's aircraft and flights."""
        if self.only is None:
            return f"{sql} {end}", [*arguments]
        pairs = ",".join(["(?, ?)"] * len(self.only))
        aircraft = f"select * from (values {pairs}) as aircraft"  # SQLite would scan the whole fleet for bare values
        query = f"{sql} and ({table}.operator, {table}.tail) in ({aircraft})"
        flights = self.flights if self.flights is not None and table != "files" else ()
        query += f" and {table}.flight_id in ({','.join('?' * len(flights))})" if flights else ""
        return f"{query} {end}", [*arguments, *chain.from_iterable(self.only), *flights]

    def _cells(self, sql: str, table: str, arguments: Iterable[str] = ()) -> pl.DataFrame:
        (frame,) = self._frames([self._restricted(sql, table, arguments)])
        return frame

    def _frames(self, queries: list[_Query]) -> list[pl.DataFrame]:
        """Run queries in one transaction; counts are text."""
        results = self._query(lambda con: [(c.description, c.fetchall()) for c in starmap(con.execute, queries)])
        types = [{c[0]: pl.Int64 if c[0] in _NUMBERS else pl.String for c in columns} for columns, _ in results]
        return [pl.DataFrame(rows, schema=t, orient="row") for t, (_, rows) in zip(types, results, strict=True)]

    def file_records(self) -> dict[str, FileRecord]:
        """Map every file on record, by path, to its record."""
        query = "select path, size, mtime_ns, digest, touched_ns from files left join touched using (path)"
        rows = self._query(lambda con: con.execute(query).fetchall())
        return {path: FileRecord(*values) for path, *values in rows}

    def register(
        self,
        files: Iterable[tuple[str, str, str, str, int, int, str]],
        cells_of_file: Mapping[str, Iterable[Cell]],
        touch_times_ns: Iterable[tuple[str, int]] = (),
        moves: Iterable[Move] = (),
    ) -> None:
        """Record new or changed files (path, operator, tail, kind, size, mtime_ns, digest) and the flights of each.

        And when files were last touched (path, time in ns). A flight that a replaced file no longer holds stays
        assigned to it: its stored rows stay, and are accounted for even where a killed night got no further. A cell
        that a file has left for that of another airframe stays, without a file, and is made once more: without rows.
        """
        rows = list(files)
        moves = list(moves)
        with self._write(settled=True) as con:
            con.executemany(_SET_FILE, rows)
            con.executemany(_SET_TOUCHED, list(touch_times_ns))
            assigned = [(r[0], *cell) for r in rows for cell in cells_of_file.get(r[0], ())]
            assigned += [(path, *new) for path, _, new in moves if new[2]]
            left = [(path, *old) for path, old, _ in moves]
            where = "path = ? and operator = ? and tail = ? and flight_id = ?"
            con.executemany(f"delete from file_flights where {where}", left)
            assigned += [("", *old) for _, old, _ in moves]
            con.executemany("insert into file_flights values (?, ?, ?, ?) on conflict do nothing", assigned)
            if con.execute("select made_as from settled").fetchall():  # else any cell may be stale
                cells = {(r[1], r[2], "") for r in rows} | {a[1:] for a in assigned}
                cells |= {(operator, tail, "") for operator, tail, _ in cells}
                con.executemany("insert into moved values (?, ?, ?) on conflict do nothing", sorted(cells))
            sys.audit("hdt.before_register")
        sys.audit("hdt.after_register")

    def files(self, kinds: Iterable[str]) -> pl.DataFrame:
        """List files of some kinds: path, operator, tail, kind, digest, size, mtime_ns; each once an airframe.

        And, with an empty path, airframes that a file has left.
        """
        kinds = list(kinds)
        marks = ",".join("?" * len(kinds)) or "null"  # PostgreSQL has no empty list
        further = (
            "select l.path, l.operator, l.tail, coalesce(f.kind, '') as kind, coalesce(f.digest, '') as digest,"
            " coalesce(f.size, 0) as size, coalesce(f.mtime_ns, 0) as mtime_ns from file_flights l"
            f" left join files f on l.path = f.path where l.flight_id = '' and (l.path = '' or f.kind in ({marks}))"
        )
        queries = ((f"select {_COLUMNS} from files where kind in ({marks})", "files"), (further, "l"))
        return pl.concat(self._frames([self._restricted(sql, table, kinds) for sql, table in queries]))

    def flight_files(self) -> pl.DataFrame:
        """List each file and flight in it: operator, tail, flight_id, path, digest, kind, size, mtime_ns."""
        columns = "l.operator, l.tail, l.flight_id, l.path, f.digest, f.kind, f.size, f.mtime_ns"
        joined = "file_flights l join files f on l.path = f.path"
        return self._cells(f"select {columns} from {joined} where l.flight_id <> ''", "l")

    def flight_inputs(self) -> pl.DataFrame:
        """List the inputs of each flight, a row a file that holds it: operator, tail, flight_id, line (path=digest).

        A flight that its file has left for another airframe has a line without path.
        """
        columns = "l.operator, l.tail, l.flight_id, l.path || '=' || coalesce(f.digest, '') as line"
        joined = "file_flights l left join files f on l.path = f.path"
        return self._cells(f"select {columns} from {joined} where l.flight_id <> ''", "l")

    def cells_of_files(self) -> list[tuple[str, str, str, str]]:
        """List each file's airframe and flights: path, operator, tail, flight_id (empty above flights)."""
        sql = (
            "select path, operator, tail, '' from files where operator <> ''"
            " union select path, operator, tail, flight_id from file_flights where path <> ''"
        )
        return self._query(lambda con: con.execute(sql).fetchall())

    def cells(self, asset: str) -> pl.DataFrame:
        """List the stored cells of an asset: operator, tail, flight_id (empty above flights), version."""
        return self.cells_of([asset])[asset]

    def lines(self, asset: str) -> pl.DataFrame:
        """Join all stored cells of an asset into one text for each aircraft: operator, tail, lines.

        A cell's line is `operator=tail=flight_id=version`; lines come in any order, separated by `|`. The database
        joins them, since a row a flight would take twice as long.
        """
        return self.cells_of([], [asset])[asset]

    def cells_of(self, assets: Iterable[str], joined: Iterable[str] = ()) -> dict[str, pl.DataFrame]:
        """Read the `cells` of some assets and the `lines` of others in one transaction."""
        cells = "select operator, tail, flight_id, version from done where asset = ?"
        fold = "string_agg" if self.url else "group_concat"
        line = "operator || '=' || tail || '=' || flight_id || '=' || version"
        lines = f"select operator, tail, {fold}({line}, '|') as lines from done where asset = ?"
        queries = {a: self._restricted(cells, "done", [a]) for a in assets}
        queries |= {a: self._restricted(lines, "done", [a], "group by operator, tail") for a in joined}
        return dict(zip(queries, self._frames([*queries.values()]), strict=True))

    def mark(self, asset: str, cells: pl.DataFrame) -> None:
        """Record that cells (operator, tail, flight_id, version) of an asset are stored and synced to disk."""
        columns = cells.select(pl.lit(asset).alias("asset"), "operator", "tail", "flight_id", "version")
        rows = sorted(columns.rows(), key=lambda row: row[:4])  # in one order, or two writers deadlock
        with self._write() as con:
            con.executemany(_SET_VERSION, rows)
            sys.audit("hdt.before_mark")
        sys.audit("hdt.after_mark")

    def settle(self, version: str) -> None:
        """Record that no cell is stale under this version of the stages."""
        with self._write() as con:
            con.execute("delete from moved")
            con.execute("insert into settled values (?)", (version,))

    def settled_version(self) -> str | None:
        """Return the version under which no cell is stale but the `changed_cells`; None where any cell may be."""
        rows = self._query(lambda con: con.execute("select made_as from settled").fetchall())
        return str(rows[0][0]) if len(rows) == 1 else None

    def changed_cells(self) -> pl.DataFrame:
        """List cells of files that came since `settle`: operator, tail, flight_id (empty for files without flights)."""
        return self._frames([("select operator, tail, flight_id from moved", [])])[0]

    def is_settled(self, version: str) -> bool:
        """Return whether no cell is stale under this version of the stages."""
        return self.settled_version() == version and self.changed_cells().is_empty()

    def flights_on_file(self) -> pl.DataFrame:
        """List the flights of all files: operator, tail, flight_id."""
        columns = "distinct operator, tail, flight_id"
        return self._cells(f"select {columns} from file_flights where flight_id <> ''", "file_flights")

    def note_night(self, row: tuple[str, str, int, int, int, int, str]) -> None:
        """Record a night that ended: began_at, ended_at, files, new_files, runs, cells, failed (JSON)."""
        with self._write(settled=True) as con:
            con.execute("insert into nights values (?, ?, ?, ?, ?, ?, ?)", row)

    def nights(self) -> pl.DataFrame:
        """List all nights, oldest first, counts as text."""
        return self._frames([(f"select * from nights order by {'ctid' if self.url else 'rowid'}", [])])[0]

    def next_night(self) -> str:
        """Name a night to be published: the time, which may jump, and its place in the sequence of nights."""
        return f"{datetime.now(UTC).isoformat(timespec='milliseconds')}#{night_number(self.last_night()) + 1}"

    def last_night(self) -> str:
        """Return the name of the last night that was published; empty where there is none."""
        rows = self._query(lambda con: con.execute("select distinct night from night_versions").fetchall())
        return max((night for (night,) in rows), key=_in_sequence, default="")

    def note_snapshot(self, versions: dict[str, int], night: str | None = None) -> None:
        """Record that a night, by default the next one, is published with these versions of the tables."""
        night = night or self.next_night()
        with self._write(settled=True) as con:
            con.executemany("insert into night_versions values (?, ?, ?)", [(night, *row) for row in versions.items()])

    def snapshots(self) -> dict[str, dict[str, int]]:
        """Map each night, in the order of publication, to the versions of the tables that it published."""
        nights: dict[str, dict[str, int]] = {}
        rows = self._query(lambda con: con.execute("select night, asset, version from night_versions").fetchall())
        for night, asset, version in sorted(rows, key=lambda row: _in_sequence(row[0])):
            nights.setdefault(night, {})[asset] = version
        return nights

    def delete_cells(
        self, assets: Iterable[str], aircraft: tuple[str, str] | None = None, flights: Iterable[str] | None = None
    ) -> None:
        """Delete the record of stored cells: of all or one aircraft, all or some of its flights."""
        only = "" if aircraft is None else " and operator = ? and tail = ?"
        only += "" if flights is None else " and flight_id = ?"
        ids = [()] if flights is None else [(flight,) for flight in flights]
        rows = [(asset, *(aircraft or ()), *flight) for asset in assets for flight in ids]
        with self._write() as con:
            con.executemany(f"delete from done where asset = ?{only}", rows)

    def delete_nights(self, nights: Iterable[str]) -> None:
        """Delete the table versions of some nights."""
        rows = [(night,) for night in nights]
        if rows:
            with self._write(settled=True) as con:
                con.executemany("delete from night_versions where night = ?", rows)

    def delete_snapshots_of(self, asset: str) -> None:
        """Delete the record of earlier versions of a table, which are lost."""
        with self._write() as con:
            con.execute("delete from night_versions where asset = ?", [asset])


def night_number(night: str) -> int:
    """Return a night's place in the sequence; 0 for those of earlier versions, which are named by their time alone."""
    return int(night.partition("#")[2] or 0)


def _in_sequence(night: str) -> tuple[int, str]:
    return night_number(night), night
