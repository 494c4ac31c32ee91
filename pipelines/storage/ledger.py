"""What was delivered and what was made of it: small tables in `<home>/ledger.sqlite`.

Where HDT_LEDGER_URL names a PostgreSQL database they are there instead, and several machines may work for one fleet.
`files` says which file holds which flights, by content hash; `done` says of which inputs each stored cell was made. A
cell is stale when the two disagree. Data are synced to disk before their line in `done` is committed, so a kill at any
moment costs work, never truth. `touched` says when files were last touched that have been read since: while that stands
they are the same. `night_versions` says which version of each table a night published. `nights` says when the chain
last ran, and what failed; `settled`, until something is noted, that nothing was stale after it: an idle night need not
look at every cell.
"""

import sys
from collections.abc import Iterable
from datetime import UTC, datetime

import polars as pl

from pipelines.storage.ledger_tables import LedgerTables

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


class Ledger(LedgerTables):
    """What the tables say, and what is noted in them."""

    def known_files(self) -> dict[str, tuple[int, int]]:
        """Size and modification time of every file seen, by path."""
        rows = self._ask(lambda con: con.execute("select path, size, mtime_ns from files").fetchall())
        return {path: (size, mtime_ns) for path, size, mtime_ns in rows}

    def digests(self) -> dict[str, str]:
        """Content hash of every file seen, by path."""
        return dict(self._ask(lambda con: con.execute("select path, digest from files").fetchall()))

    def touched(self) -> dict[str, int]:
        """When each file was last touched, by path, of those that were read long enough after that."""
        return dict(self._ask(lambda con: con.execute("select path, touched_ns from touched").fetchall()))

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
