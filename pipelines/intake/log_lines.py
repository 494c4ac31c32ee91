"""Lines of a short list in CSV: each judged by itself, each stored once."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime

import polars as pl

from pipelines.intake.header import judge_header
from pipelines.intake.ledger import Fault
from pipelines.intake.text import Text, open_text
from pipelines.intake.text_columns import to_columns
from pipelines.intake.times import to_utc, zone_note

Row = tuple[object, ...]
Words = dict[str, str]
"""Fields of a line by column, stripped; empty where the file has no such column."""


@dataclass(frozen=True, slots=True)
class Columns:
    """Columns of a list: those it must have, those it may lack, and `extra` ones that nobody misses."""

    required: tuple[str, ...]
    optional: tuple[str, ...] = ()
    extra: tuple[str, ...] = ()
    timed: str | None = None
    """Column of times, which are parsed in bulk."""
    unique: int = 0
    """Leading fields that are a key: of several lines with one key the first counts. 0: whole lines are compared."""


@dataclass(frozen=True, slots=True)
class Log:
    """Rows of a log, each once; what is wrong with it; `n_delivered` = rows + `n_duplicate` + quarantined `n_rows`."""

    rows: pl.DataFrame
    quarantine: pl.DataFrame
    n_delivered: int
    n_duplicate: int

    @property
    def n_loaded(self) -> int:
        """Rows stored."""
        return self.rows.height


@dataclass(frozen=True, slots=True)
class Lines:
    """Good lines, each once; what is wrong with the others; lines delivered, and those that repeat another."""

    rows: list[Row]
    faults: list[Fault]
    n_delivered: int
    n_duplicate: int


def judge_lines(content: bytes, columns: Columns, judge: Callable[[Words, datetime | None], Row | Fault]) -> Lines:
    """Open a list, judge its lines and drop those that stand twice."""
    required, optional, extra = columns.required, columns.optional, columns.extra
    text = open_text(content, lambda names: judge_header(names, required, optional, extra=extra))
    lines, line_faults = to_columns([text], ())
    nothing_happened = () if columns.unique else ("no_rows",)  # an aircraft without messages has a header alone
    faults = [f for f in (*text.faults, *line_faults[0]) if f.reason not in nothing_happened]
    good: dict[Row, int] = {}
    for row, words, moment in _words(lines, columns, faults):
        verdict = judge(words, moment)
        if isinstance(verdict, Fault):
            faults.append(_placed(verdict, row, text))
        else:
            good.setdefault(verdict, row)
    n_duplicate = text.n_rows - len(good) - sum(f.n_rows for f in faults)
    rows = _first_of_key(good, columns.unique, text, faults) if columns.unique else sorted(good, key=_in_order)
    return Lines(rows, faults, text.n_rows, n_duplicate)


def _words(lines: pl.DataFrame, columns: Columns, faults: list[Fault]) -> list[tuple[int, Words, datetime | None]]:
    if lines.is_empty():
        return []
    moments: list[datetime | None] = [None] * lines.height
    if columns.timed is not None:
        parsed, naive = to_utc(lines.select(columns.timed, "row"), columns.timed)
        moments = parsed.get_column(columns.timed).to_list()
        faults.extend(zone_note(naive, columns.timed))
    names = (*columns.required, *columns.optional, *columns.extra)
    rows = lines.iter_rows(named=True)
    return [(r["row"], {c: printable(r.get(c)) for c in names}, m) for r, m in zip(rows, moments, strict=True)]


def printable(field: str | None) -> str:
    """A field without what can't be printed, cut at 500 characters."""
    return "".join(c for c in (field or "").strip() if c.isprintable())[:500]


def _placed(fault: Fault, row: int, text: Text) -> Fault:
    return Fault(fault.reason, row, fault.column_name, fault.detail, 1, content=text.line(row))


def _in_order(row: Row) -> tuple[tuple[bool, str], ...]:
    return tuple((field is None, str(field)) for field in row)


def _first_of_key(good: dict[Row, int], n_key: int, text: Text, faults: list[Fault]) -> list[Row]:
    """Of rows with the same leading fields the first in the file; the others go to the faults."""
    first: dict[Row, Row] = {}
    for row, line in sorted(good.items(), key=lambda item: item[1]):
        if row[:n_key] in first:
            detail = f"Listed twice with other values; line {good[first[row[:n_key]]]} counts."
            faults.append(_placed(Fault("bad_key", detail=detail), line, text))
        else:
            first[row[:n_key]] = row
    return list(first.values())
