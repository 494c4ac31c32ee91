"""Log what people did about alerts: an append-only table in `<home>/cases.sqlite`.

Where HDT_LEDGER_URL names a PostgreSQL database the log is a table `cases` there, as the ledger is: several machines
may work for one fleet. A line is written in a transaction that reads all lines before it, so of two people who change
one case at the same time the second gets an error, and nobody's line is lost. Each night copies the log to `raw_cases`,
and puts back lines that the log lacks, as after the file was lost or an older copy of it restored. A line is known by
its `id`: its number is its place, which may change then.
"""

import hashlib
import heapq
import json
import os
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from secrets import token_hex
from typing import Any

import polars as pl
from polars.exceptions import PolarsError

from hdt_core.alerts.succession import KINDS_OF_NIGHT
from hdt_core.loading import UserError
from hdt_core.tables import TABLES
from pipelines.storage.database import URL, Database, query_value
from pipelines.storage.objects import message_of

FILE = "cases.sqlite"
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
_TIMES, _DAYS = ("at", "until", "done_at", "raised_then", "last_then"), ("done_on",)
_Line = dict[str, Any]
"""A line as a row of `raw_cases`, its times as text."""
NIGHT = "night"
"""Author of the night's own lines."""
_IDENTITY = ("at", "alert_id", "kind", "person")
"""Columns that tell lines apart which have no id."""


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
            acknowledge, assign, mute, watch, unwatch, close or reopen; follow or withdraw.
        person : str
            Who.
        body : mapping, optional
            Columns of `raw_cases` that belong to the kind, and `case_id` where it is not the alert's id; text, numbers,
            days and times as text.
        expected_line : int, optional
            Number of the last line about this case that its writer has read, 0 for none; None writes in any case.

        Raises
        ------
        ConflictError
            Another person's line is the last about the case.
        """
        content = {"id": token_hex(8), "case_id": alert["alert_id"]} | dict(body or {})
        with self._writing() as con:
            lines = _read_lines(con)
            joined = {
                r["case_id"] for r in {r["case_id"]: r for r in lines}.values() if r["alert_id"] == alert["alert_id"]
            }
            of_case = [r for r in lines if r["case_id"] in {content["case_id"], *joined}]
            last = next((r for r in reversed(of_case) if r["kind"] not in KINDS_OF_NIGHT), None)
            if expected_line is not None and expected_line != (last["line"] if last else 0):
                raise ConflictError(
                    f"{last['person']} changed this case in the meantime ({last['kind']}, {last['at']:.16}); look again"
                    if last and last["line"] > expected_line
                    else f"line {expected_line} of the log is none about this case; look again"
                )
            number = lines[-1]["line"] + 1 if lines else 1
            at = datetime.now(UTC).isoformat(timespec="microseconds")
            own = (alert[c] for c in _OWN[2:8])
            con.execute(_ADD, (number, at, *own, kind, person, _text(content)))
        return int(number)

    def version(self) -> str:
        """Return what differs after another line; empty where there is none."""
        lines = self._lines()
        return f"{len(lines)} {lines[-1]['id']}" if lines else ""

    def entries(self) -> pl.DataFrame:
        """Read all lines as rows of `raw_cases`, in order."""
        rows = self._lines()
        schema = TABLES["raw_cases"].schema
        if not rows:
            return schema.create_empty()
        frame = pl.DataFrame(rows, infer_schema_length=None)
        times, days = ([c for c in columns if c in frame.columns] for columns in (_TIMES, _DAYS))
        return schema.conform(
            frame.with_columns(
                pl.col(times).cast(pl.String).str.to_datetime("%+", time_unit="us", time_zone="UTC"),
                pl.col(days).cast(pl.String).str.to_date(),
            )
        )

    def fault(self, stored: pl.DataFrame) -> str | None:
        """Check the log; the fault in words, None where it is whole.

        Lines that a night has `stored` must be there and the same: SQLite has no checksums of its pages, and a copy
        of the log that was put back lacks the last ones.
        """
        if damage := self._damage():
            return damage
        own = self.entries()
        stored_rows = with_ids(stored)
        n_missing = stored_rows.join(own, on="id", how="anti").height
        if n_missing:
            return f"lacks {n_missing} lines that the tables hold" if own.height else "is gone"
        both = (own.join(stored_rows, on="id", how="semi"), stored_rows)
        is_same = both[0].drop("line").sort("id").equals(both[1].select(own.columns).drop("line").sort("id"))
        return None if is_same else "holds a line that is not what was written"

    def _damage(self) -> str | None:
        """Describe the damage of a file that can't be read, None where there is none, or on a server."""
        path = self.home / FILE
        if self.url or not path.exists():
            return None
        answer = query_value(path, "pragma integrity_check(1)")
        if answer != "ok":
            return f"is damaged ({answer})"
        try:
            self.entries()
        except (ValueError, sqlite3.DatabaseError, PolarsError) as error:
            return f"is damaged ({message_of(error)})"
        return None

    def repair(self, stored: pl.DataFrame) -> str | None:
        """Join the log's lines and those that the nights have stored where one of these is missing or not the same.

        Returns
        -------
        str or None
            The fault and what became of it, in words; None where there was none.
        """
        fault = self.fault(stored)
        path = self.home / FILE
        if fault is None:
            return None
        rescued = self._readable_lines()
        is_damaged = self._damage() is not None
        if is_damaged:
            path.rename(path.with_name(f"{FILE}.damaged"))
            fault = f"{fault} ({FILE}.damaged)"
        stored_rows = [
            {k: v for k, v in row.items() if v is not None} for row in with_ids(stored).sort("line", "at").to_dicts()
        ]
        stored_rows = [row | {"at": row["at"].isoformat(timespec="microseconds")} for row in stored_rows]
        stored_ids = {row["id"] for row in stored_rows}
        with self._writing() as con:
            own = rescued if is_damaged else _read_lines(con)
            since = [row for row in own if row["id"] not in stored_ids]
            _rewrite(con, heapq.merge(stored_rows, since, key=lambda row: str(row["at"])), is_file=not self.url)
        if not stored_ids:
            return f"the log of cases {fault}; it begins anew with {len(since)} lines"
        put_back = len(stored_ids - {row["id"] for row in own}) or len(stored_ids)
        end = f"and {len(since)} since the last night" if since else "and those since the last night, if any, are lost"
        return f"the log of cases {fault}; {put_back} lines are put back, {end}"

    def _readable_lines(self) -> list[_Line]:
        """Read the lines of a log that may be damaged; none where it can't be read."""
        try:
            return self._lines()
        except (ValueError, sqlite3.DatabaseError):
            return []

    def _lines(self) -> list[_Line]:
        return self._database.query(_read_lines)


def with_ids(rows: pl.DataFrame) -> pl.DataFrame:
    """Return rows of `raw_cases` with the ids that `_as_row` gives to lines from before there were any."""
    old = [_line_id(at.isoformat(timespec="microseconds"), *own) for at, *own in rows.select(*_IDENTITY).iter_rows()]
    return rows.with_columns(
        pl.coalesce("id", pl.Series(old, dtype=pl.String)).alias("id"),
        pl.coalesce("case_id", "alert_id").alias("case_id"),
    )


def _read_lines(con: Any) -> list[_Line]:
    query = f"select {', '.join(_OWN)}, body from cases order by line"
    return [_as_row(values) for values in con.execute(query).fetchall()]


def _as_row(values: tuple[Any, ...]) -> _Line:
    """Return a line with its id and case; of one that has none, a hash of it and the alert's id."""
    own = dict(zip(_OWN, values, strict=False))
    old = {"id": _line_id(*(own[c] for c in _IDENTITY)), "case_id": own["alert_id"]}
    body: _Line = json.loads(values[-1])
    return old | own | body


def _line_id(*values: object) -> str:
    return hashlib.sha256("|".join(map(str, values)).encode()).hexdigest()[:16]


def _rewrite(con: Any, rows: Iterable[_Line], is_file: bool) -> None:
    """Write all lines anew, numbered in this order."""
    if is_file:
        con.execute("drop trigger no_delete")
    numbered_rows = [(n, *(row[c] for c in _OWN[1:]), _body_of(row)) for n, row in enumerate(rows, 1)]
    con.execute("delete from cases")
    con.executemany(_ADD, numbered_rows)
    if is_file:
        con.execute(_NEVER[1])


def _body_of(row: _Line) -> str:
    return _text({k: v for k, v in row.items() if k not in _OWN})


def _text(body: Mapping[str, Any]) -> str:
    return json.dumps(dict(body), ensure_ascii=False, sort_keys=True, default=str)
