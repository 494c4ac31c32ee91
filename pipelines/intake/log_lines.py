"""Parse a short list in CSV: each line validated by itself, each stored once."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime

import polars as pl

from pipelines.intake.faults import Fault
from pipelines.intake.header import match_header
from pipelines.intake.text import Text, open_text
from pipelines.intake.text_columns import to_columns
from pipelines.intake.times import to_utc, zone_note

Row = tuple[object, ...]
Words = dict[str, str]
"""Fields of a line by column, stripped; empty where the file has no such column."""


@dataclass(frozen=True, slots=True)
class Columns:
    """Columns of a list: required ones, optional ones, and `extra` ones whose absence is never a sign of renaming."""

    required: tuple[str, ...]
    optional: tuple[str, ...] = ()
    extra: tuple[str, ...] = ()
    time: str | None = None
    """Column of times, which are parsed in bulk."""
    unique: int = 0
    """Leading fields that are a key: of several lines with one key the first counts. 0: whole lines are compared."""


@dataclass(frozen=True, slots=True)
class Log:
    """Rows of a log, each once; quarantine rows; `n_delivered` = rows + `n_duplicate` + quarantined `n_rows`."""

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
    """Good lines, each once; faults of the others; the numbers of delivered and duplicate lines."""

    rows: list[Row]
    faults: list[Fault]
    n_delivered: int
    n_duplicate: int


def parse_list(content: bytes, columns: Columns, validate: Callable[[Words, datetime | None], Row | Fault]) -> Lines:
    """Open a list, validate its lines and drop duplicates."""
    required, optional, extra = columns.required, columns.optional, columns.extra
    text = open_text(content, lambda names: match_header(names, required, optional, extra=extra))
    lines, line_faults = to_columns([text], ())
    nothing_happened = () if columns.unique else ("no_rows",)  # an aircraft without messages has a header alone
    faults = [f for f in (*text.faults, *line_faults[0]) if f.reason not in nothing_happened]
    good: dict[Row, int] = {}
    for row, words, moment in _words(lines, columns, faults):
        result = validate(words, moment)
        if isinstance(result, Fault):
            faults.append(_row_fault(result, row, text))
        else:
            good.setdefault(result, row)
    n_duplicate = text.n_rows - len(good) - sum(f.n_rows for f in faults)
    rows = _first_of_key(good, columns.unique, text, faults) if columns.unique else sorted(good, key=_sort_key)
    return Lines(rows, faults, text.n_rows, n_duplicate)


def _words(lines: pl.DataFrame, columns: Columns, faults: list[Fault]) -> list[tuple[int, Words, datetime | None]]:
    if lines.is_empty():
        return []
    moments: list[datetime | None] = [None] * lines.height
    if columns.time is not None:
        times, naive = to_utc(lines.select(columns.time, "row"), columns.time)
        moments = times.get_column(columns.time).to_list()
        faults.extend(zone_note(naive, columns.time))
    names = (*columns.required, *columns.optional, *columns.extra)
    rows = lines.iter_rows(named=True)
    return [(r["row"], {c: printable(r.get(c)) for c in names}, m) for r, m in zip(rows, moments, strict=True)]


def printable(field: str | None) -> str:
    """Strip a field of non-printable characters and cut it at 500."""
    return "".join(c for c in (field or "").strip() if c.isprintable())[:500]


def _row_fault(fault: Fault, row: int, text: Text) -> Fault:
    return Fault(fault.reason, row, fault.column_name, fault.detail, 1, content=text.line(row))


def _sort_key(row: Row) -> tuple[tuple[bool, str], ...]:
    return tuple((field is None, str(field)) for field in row)


def _first_of_key(good: dict[Row, int], n_key: int, text: Text, faults: list[Fault]) -> list[Row]:
    """Keep the first of rows with the same leading fields; the others go to the faults."""
    first: dict[Row, Row] = {}
    for row, line in sorted(good.items(), key=lambda item: item[1]):
        if row[:n_key] in first:
            detail = f"Listed twice with other values; line {good[first[row[:n_key]]]} counts."
            faults.append(_row_fault(Fault("bad_key", detail=detail), line, text))
        else:
            first[row[:n_key]] = row
    return list(first.values())
