"""Report what a night did not read: unknown names, quarantined rows, columns that fell silent."""

from collections.abc import Collection, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import polars as pl

from pipelines.intake.faults import REASONS
from pipelines.words import _, several

if TYPE_CHECKING:
    import duckdb

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


def ignored_entries(entries: pl.DataFrame) -> list[str]:
    """List the names in the landing zone that are not read; those with one reason in one folder share a line."""
    folder = pl.col("file").str.replace(r"/?[^/]*$", "")
    groups = entries.group_by(folder.alias("folder"), "detail", maintain_order=True).agg("file")
    lines = []
    for _folder, detail, files in groups.iter_rows():
        names, more = ", ".join(files[:MAX_NAMES]), len(files) - MAX_NAMES
        lines.append(f"{_('{names} and {n} more', names=names, n=more) if more > 0 else names}: {detail}")
    return _limit_lines(lines, _("the view quarantine has them"))


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


def silent_columns(con: "duckdb.DuckDBPyConnection") -> list[Row]:
    """Query the view `silent_columns`, the column with most refusals first."""
    return list(con.sql(_SILENT).pl().iter_rows(named=True))


def silent_lines(rows: Iterable[Row]) -> list[str]:
    """Report each column that fell silent in a line."""
    return _limit_lines(
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
    return f"{sentence} {_('It fits {unit}.', unit=row['fits'])}" if row["fits"] else sentence


def _limit_lines(lines: list[str], where: str) -> list[str]:
    more = len(lines) - MAX_LINES
    return [*lines[:MAX_LINES], _("and {n} more: {where}", n=more, where=where)] if more > 0 else lines
