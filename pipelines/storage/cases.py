"""Log what people did about alerts: an append-only table in `<home>/cases.sqlite`.

Where HDT_LEDGER_URL names a PostgreSQL database the log is a table `cases` there, as the ledger is: several machines
may work for one fleet. A line is written in a transaction that reads all lines before it, so of two people who change
one case at the same time the second gets an error, and nobody's line is lost. Each night copies the log to `raw_cases`.
"""

import json
import os
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import polars as pl
from polars.exceptions import PolarsError

from hdt_core.loading import UserError
from hdt_core.tables import TABLES
from pipelines.storage.database import URL, Database, query_value
from pipelines.storage.objects import message_of

FILE = "cases.sqlite"
*FAULTS, NO_FAULT = FINDINGS = ("FOULED", "CLOGGED", "CORRODED", "DAMAGED", "NO_FAULT_FOUND")
"""Codes of an inspection's finding, in the maintenance log and in the log of cases."""
_SCHEMA = """create table if not exists cases (
    line bigint primary key, at text not null, alert_id text not null, operator text not null, tail text not null,
    pack integer, component text not null, diagnosis text not null, kind text not null, person text not null,
    body text not null
)"""
_NEVER = tuple(
    f"create trigger if not exists no_{what} before {what} on cases"
    " begin select raise(abort, 'the log of cases is only added to'); end"
    for what in ("update", "delete")
)
_OWN = ("line", "at", "alert_id", "operator", "tail", "pack", "component", "diagnosis", "kind", "person")
_ADD = f"insert into cases ({', '.join(_OWN)}, body) values ({', '.join('?' * (len(_OWN) + 1))})"


class ConflictError(UserError):
    """Somebody else changed the case since it was read; the message names who, when and how."""


@dataclass(frozen=True)
class CaseLog:
    """The log of one home."""

    home: Path
    url: str = field(default_factory=lambda: os.environ.get(URL, ""), repr=False)  # may name a password

    @property
    def _database(self) -> Database:
        return Database(self.home / FILE, self.url, _SCHEMA, _NEVER, "delete")

    @contextmanager
    def _writing(self) -> Iterator[Any]:
        """Open a transaction that no other writer's overlaps."""
        with self._database.transaction() as con:
            if self.url:
                con.execute("lock table cases in share row exclusive mode")
            yield con

    def append(
        self, alert: Mapping[str, Any], kind: str, person: str, body: Mapping[str, Any] | None = None,
        expected_line: int | None = None,
    ) -> int:  # fmt: skip
        """Add one line about an alert; its number.

        Parameters
        ----------
        alert : mapping
            `alert_id, operator, tail, pack, component, diagnosis`.
        kind : str
            acknowledge, assign, mute, watch, unwatch, close or reopen.
        person : str
            Who.
        body : mapping, optional
            Columns of `raw_cases` that belong to the kind; text, numbers, days and times as text.
        expected_line : int, optional
            Number of the last line about this alert that its writer has read, 0 for none; None writes in any case.

        Raises
        ------
        ConflictError
            Another line is the last about the alert.
        """
        name = alert["alert_id"]
        with self._writing() as con:
            last = con.execute(
                "select line, person, kind, at from cases where alert_id = ? order by line desc limit 1", (name,)
            ).fetchone()
            if expected_line is not None and expected_line != (last[0] if last else 0):
                raise ConflictError(
                    f"{last[1]} changed this case in the meantime ({last[2]}, {last[3][:16]}); look again"
                    if last and last[0] > expected_line
                    else f"line {expected_line} of the log is none about this case; look again"
                )
            number = 1 + _last_line(con)
            at = datetime.now(UTC).isoformat(timespec="microseconds")
            own = (alert[c] for c in _OWN[2:8])
            con.execute(_ADD, (number, at, *own, kind, person, _text(body or {})))
        return number

    def last_line(self) -> int:
        """Return the number of the last line, 0 where there is none."""
        return self._database.query(_last_line)

    def entries(self) -> pl.DataFrame:
        """Read all lines as rows of `raw_cases`, in order."""
        rows = [dict(zip(_OWN, row, strict=False)) | json.loads(row[-1]) for row in self._lines()]
        schema = TABLES["raw_cases"].schema
        if not rows:
            return schema.create_empty()
        frame = pl.DataFrame(rows, infer_schema_length=None)
        times = [c for c in ("at", "until", "done_at") if c in frame.columns]
        days = [c for c in ("done_on",) if c in frame.columns]
        return schema.conform(
            frame.with_columns(
                pl.col(times).cast(pl.String).str.to_datetime("%+", time_unit="us", time_zone="UTC"),
                pl.col(days).cast(pl.String).str.to_date(),
            )
        )

    def fault(self, stored: pl.DataFrame) -> str | None:
        """Check the file; the fault in words, None where it is whole, where there is none, or on a server.

        Lines that a night has `stored` must be the same: SQLite has no checksums of its pages.
        """
        path = self.home / FILE
        if self.url or not path.exists():
            return None
        answer = query_value(path, "pragma integrity_check(1)")
        if answer != "ok":
            return f"is damaged ({answer})"
        try:
            current, line = self.entries(), ["line", "at"]
        except (ValueError, sqlite3.DatabaseError, PolarsError) as error:
            return f"is damaged ({message_of(error)})"
        both = [
            one.join(other, on=line, how="semi").sort(line) for one, other in ((current, stored), (stored, current))
        ]
        return None if both[0].equals(both[1].select(current.columns)) else "holds a line that is not what was written"

    def repair(self, stored: pl.DataFrame) -> str | None:
        """Restore the lines that the nights have stored, where the log is gone or damaged; the fault in words."""
        fault, path = self.fault(stored), self.home / FILE
        since = self._lines_after(stored["line"].max()) if fault else []
        if fault:
            path.rename(path.with_name(f"{FILE}.damaged"))
        if stored.is_empty() or self._lines():
            return f"the log of cases {fault}; it begins anew, the old one is {FILE}.damaged" if fault else None
        with self._writing() as con:
            con.executemany(_ADD, since)
            for row in stored.sort("line").iter_rows(named=True):
                body = {k: v for k, v in row.items() if k not in _OWN and v is not None}
                own = [row["at"].isoformat(timespec="microseconds") if c == "at" else row[c] for c in _OWN]
                con.execute(_ADD, (*own, _text(body)))
        what = f"{fault} ({FILE}.damaged)" if fault else "was gone"
        end = f"and {len(since)} since the last night" if since else "those since the last night are lost"
        return f"the log of cases {what}; {stored.height} lines are put back, {end}"

    def _lines_after(self, last: object) -> list[tuple[Any, ...]]:
        """Read the lines of a damaged log that no night has stored, as far as possible."""
        try:
            return [line for line in self._lines() if isinstance(last, int) and line[0] > last]
        except (ValueError, sqlite3.DatabaseError):
            return []

    def _lines(self) -> list[tuple[Any, ...]]:
        query = f"select {', '.join(_OWN)}, body from cases order by line"
        return self._database.query(lambda con: list(con.execute(query).fetchall()))


def _last_line(con: Any) -> int:
    return int(con.execute("select coalesce(max(line), 0) from cases").fetchone()[0])


def _text(body: Mapping[str, Any]) -> str:
    return json.dumps(dict(body), ensure_ascii=False, sort_keys=True, default=str)
