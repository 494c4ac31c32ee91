"""Describe faults of delivered files, rows and values as quarantine rows; report what a night did not read."""

import tomllib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from importlib.resources import files
from typing import TYPE_CHECKING, Any, NamedTuple

import polars as pl
from polars.exceptions import PanicException

from hdt_core.tables.raw import RawQuarantine
from pipelines.words import _, format_count, several

if TYPE_CHECKING:
    import duckdb


NO_FAULTS = pl.DataFrame(schema=RawQuarantine.types("operator", "tail"))
"""`row` is the line of a text file (header = 1) or the row of a Parquet file, from 1; null for the whole file.
`n_rows` is how many delivered rows the entry keeps out of the store: all of a file, 1 for a row, else 0.
`content` is the rejected row as delivered, cut at 500 characters."""


class Reason(NamedTuple):
    """One class of bad input; `scope` names what is not stored, as `reasons.toml` groups them."""

    scope: str
    sentence: str
    remedy: str


REASONS = {
    code: Reason(scope, *texts)
    for scope, codes in tomllib.loads((files(__package__) / "reasons.toml").read_text("utf-8")).items()
    for code, texts in codes.items()
}
BREAKS_DECLARATION = "breaks_declaration"
"""Reason of computed rows that violate their table's declaration."""
MAX_VALUES_LISTED = 100
"""Values at fault that are listed singly for a file, column and reason; the rest is counted in one entry."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing wrong with one file, row or value."""

    reason: str
    row: int | None = None
    column_name: str | None = None
    detail: str = ""
    n_rows: int = 0
    flight_id: str | None = None
    content: str | None = None


MAX_ROWS_LISTED = 10_000
"""Rows at fault that are listed singly for a file and reason, since a hostile file may have a million."""


def first_and_rest(frame: pl.DataFrame, by: Sequence[str], limit: int) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Take the first `limit` rows of each group, and count the others of larger groups (`more`)."""
    if frame.height <= limit:
        return frame, frame.select(by).clear().with_columns(pl.lit(0, pl.Int64).alias("more"))
    first = frame.filter(pl.int_range(pl.len()).over(by) < limit)
    rest = frame.group_by(by, maintain_order=True).agg((pl.len().cast(pl.Int64) - limit).alias("more"))
    return first, rest.filter(pl.col("more") > 0)


def quarantine(file: str, received_at: datetime | None, faults: Iterable[Fault]) -> pl.DataFrame:
    """Turn faults of one file into quarantine rows; the detail begins with the sentence of the reason."""
    rows = []
    for f in faults:
        scope, sentence, _remedy = REASONS[f.reason]
        detail = f"{sentence} {f.detail}".strip()
        content = f.content and f.content[:500]
        rows.append((file, f.row, f.column_name, f.reason, detail, scope, f.flight_id, received_at, f.n_rows, content))
    return pl.DataFrame(rows, schema=NO_FAULTS.schema, orient="row")


def limit_values(values: list[Fault]) -> list[Fault]:
    """Limit faults of single values: the first of each column and reason singly, the others in one count."""
    counts: dict[tuple[str, str | None], int] = {}
    short = []
    for fault in values:
        key = (fault.reason, fault.column_name)
        counts[key] = counts.get(key, 0) + 1
        if counts[key] <= MAX_VALUES_LISTED:
            short.append(fault)
    more = [(key, n - MAX_VALUES_LISTED) for key, n in counts.items() if n > MAX_VALUES_LISTED]
    return short + [Fault(reason, None, column, f"And {n} more values.") for (reason, column), n in more]


MAX_LINES = 5
"""Lines of a kind; the rest is counted."""
MAX_NAMES = 3
"""Names that share a line."""
Row = Mapping[str, Any]
_SILENT = "select * from silent_columns order by n_refused desc, operator, tail, folder, column_name"
_QUARANTINE_ROWS = """
select file, reason, sum(n_rows)::bigint as n_rows from quarantine
where n_rows > 0 group by file, reason order by n_rows desc, file, reason
"""
_REFUSED_LOGS = """
with refused as (
    select file, reason, sum(n_rows)::bigint as n from quarantine where scope in ('file', 'row') group by file, reason
)
select d.file, d.quarantined, d.delivered, q.reasons from deliveries as d
inner join (
    select file, list((reason, n) order by n desc, reason) as reasons from refused group by file
) as q on d.file = q.file
where regexp_matches(d.file, '(^|/)(messages|maintenance|fleet)[.]csv$') and 2 * d.quarantined >= d.delivered
and d.quarantined > 0
order by d.file
"""
_JUDGED_WORK = """
select operator, tail, pack, component, reference, done_on, note from maintenance
where note is not null and status is null order by done_on desc, operator, tail, pack
"""

_OF_FILES = """
select distinct file, scope = 'note' as is_note, reason from quarantine
where scope in ('file', 'note') or file in (select file from deliveries where delivered > 0 and loaded + duplicate = 0)
order by file, reason
"""


def ignored_entries(entries: pl.DataFrame) -> list[str]:
    """List the names in the landing zone that are not read; those with one reason in one folder share a line."""
    folder = pl.col("file").str.replace(r"/?[^/]*$", "")
    groups = entries.group_by(folder.alias("folder"), "detail", maintain_order=True).agg("file")
    lines = []
    for _folder, detail, paths in groups.iter_rows():
        names = ", ".join(paths[:MAX_NAMES])
        n_more = len(paths) - MAX_NAMES
        place = _("{names} and {n} more", names=names, n=n_more) if n_more > 0 else names
        lines.append(f"{place}: {detail}")
    return limit_lines(lines, _("the view quarantine has them"))


def quarantine_line(con: "duckdb.DuckDBPyConnection", new_files: Collection[str]) -> str:
    """Report in one line the quarantined rows of the new files, with the worst file; empty where there are none."""
    own = [row for row in con.execute(_QUARANTINE_ROWS).fetchall() if row[0] in new_files]
    if not own:
        return ""
    file, reason, worst = own[0]
    return _(
        "{rows} of {files}, most of them of {file} ({worst}): {reason} All: {query}",
        rows=several("{n} row", "{n} rows", sum(n for *_rest, n in own)),
        files=several("{n} file", "{n} files", len({file for file, *_rest in own})),
        file=file,
        worst=worst,
        reason=REASONS[reason].sentence,
        query='hdt query "select * from quarantine where n_rows > 0"',
    )


def file_lines(con: "duckdb.DuckDBPyConnection", new_files: Collection[str], *, notes: bool) -> list[str]:
    """List the new files of which nothing is stored, or those with `notes`, and why; those alike share a line."""
    reasons = con.sql(_OF_FILES).pl().filter(pl.col("file").is_in(list(new_files)), pl.col("is_note") == notes)
    sentences = {code: reason.sentence for code, reason in REASONS.items()}
    return ignored_entries(reasons.with_columns(detail=pl.col("reason").replace(sentences)))


def refused_logs(con: "duckdb.DuckDBPyConnection") -> list[str]:
    """Report each log and list of which most lines are refused, and why: no alert can make up for what they lack.

    Messages, maintenance and the fleet list.
    """
    lines = [
        _("{file}: {n} of {lines} lines refused: {reason}", file=file, n=n, lines=n_lines, reason=_why(reasons))
        for file, n, n_lines, reasons in con.execute(_REFUSED_LOGS).fetchall()
    ]
    return limit_lines(lines, _("the view quarantine has them"))


def judged_work_lines(con: "duckdb.DuckDBPyConnection") -> list[str]:
    """Report work that was taken otherwise than it is logged."""
    of_pack = _("pack")
    lines = [
        f"{operator} {tail} {of_pack} {pack} {component} {reference or ''} {done_on}: {note}"
        for operator, tail, pack, component, reference, done_on, note in con.execute(_JUDGED_WORK).fetchall()
    ]
    return limit_lines(lines, "hdt query 'from maintenance'")


def _why(reasons: Sequence[tuple[str, int]]) -> str:
    """Format the sentence of one reason, or several in a word or two with their lines, the most frequent first."""
    first = reasons[0][0]
    if len(reasons) == 1 and first in REASONS:
        return REASONS[first].sentence
    return ", ".join(f"{format_count(n)} {reason.replace('_', ' ')}" for reason, n in reasons)


def silent_columns(con: "duckdb.DuckDBPyConnection") -> list[Row]:
    """Query the view `silent_columns`, the column with most refusals first."""
    return list(con.sql(_SILENT).pl().iter_rows(named=True))


def silent_lines(rows: Iterable[Row]) -> list[str]:
    """Report each column that fell silent in a line."""
    return limit_lines(
        [f"{r['operator']} {r['tail']}: {describe_silence(r)}" for r in rows], "hdt query 'from silent_columns'"
    )


def describe_silence(row: Row) -> str:
    """Describe a silent column: how much of it, since when, in which file, and the unit that it is likely in."""
    flight = row["since_flight"]
    sentence = _(
        "{column} refused in {share} of {n} rows since {day} leg {leg} ({reason}), last in {file}.",
        column=row["column_name"] or _("everything"),
        share=f"{min(row['n_refused'] / row['n_delivered'], 1.0):.0%}".replace("%", " %"),
        n=row["n_delivered"],
        day=f"{flight[:4]}-{flight[4:6]}-{flight[6:8]}" if flight else "?",
        leg=flight[9:] if flight else "?",
        reason=row["reason"].replace("_", " "),
        file=row["file"],
    )
    if not row["fits"]:
        return sentence
    unit = _("It fits {unit}.", unit=row["fits"])
    return f"{sentence} {unit}"


def limit_lines(lines: list[str], where: str) -> list[str]:
    """Limit lines of a kind; the rest is counted, and `where` shows it."""
    more = len(lines) - MAX_LINES
    return [*lines[:MAX_LINES], _("and {n} more: {where}", n=more, where=where)] if more > 0 else lines


class PanicError(RuntimeError):
    """Polars panicked on the data."""


@contextmanager
def panics_as_errors() -> Iterator[None]:
    """Raise a panic inside the block as a `PanicError`."""
    try:
        yield
    except PanicException as panic:
        raise PanicError(str(panic)) from None


def first_line(error: BaseException) -> str:
    """Format an error in one line: its type and the start of its message."""
    return f"{type(error).__name__}: {str(error).splitlines()[0][:200]}" if str(error) else type(error).__name__
