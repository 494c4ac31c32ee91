"""What a night must say of what it did not take: names that fit nothing, rows set aside, columns that fell silent."""

from collections.abc import Collection, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import polars as pl

from pipelines.intake.reasons import REASONS
from pipelines.words import _, several

if TYPE_CHECKING:
    import duckdb

MOST = 5
"""Lines of a kind; the rest is counted."""
NAMED = 3
"""Names that share a line."""
Row = Mapping[str, Any]
_SILENT = "select * from silent_columns order by n_refused desc, operator, tail, folder, column_name"
_ASIDE = """
select file, reason, sum(n_rows)::bigint as n_rows from quarantine
where n_rows > 0 group by file, reason order by n_rows desc, file, reason
"""


def not_read(refused: pl.DataFrame) -> list[str]:
    """A line for each name in the landing zone that is not read; those alike in one folder share a line."""
    folder = pl.col("file").str.replace(r"/?[^/]*$", "")
    alike = refused.group_by(folder.alias("folder"), "detail", maintain_order=True).agg("file")
    lines = []
    for _folder, detail, files in alike.iter_rows():
        named, more = ", ".join(files[:NAMED]), len(files) - NAMED
        lines.append(f"{_('{names} and {n} more', names=named, n=more) if more > 0 else named}: {detail}")
    return _shortened(lines, _("the view quarantine has them"))


def set_aside(con: "duckdb.DuckDBPyConnection", came: Collection[str]) -> str:
    """One line on the rows of the files that `came` that are kept aside, with the worst file; empty where none is."""
    own = [row for row in con.execute(_ASIDE).fetchall() if row[0] in came]
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
    """Rows of the view `silent_columns`, the most that was refused first."""
    return list(con.sql(_SILENT).pl().iter_rows(named=True))


def silent_lines(rows: Iterable[Row]) -> list[str]:
    """A line for each column that fell silent."""
    return _shortened([f"{r['operator']} {r['tail']}: {silence(r)}" for r in rows], "hdt query 'from silent_columns'")


def silence(row: Row) -> str:
    """What fell silent, how much of it, since when, in which file, and the unit that it is likely in."""
    flight = row["since_flight"]
    said = _(
        "{column} refused in {share} of {n} rows since {day} leg {leg} ({reason}), last in {file}.",
        column=row["column_name"] or _("everything"),
        share=f"{min(row['n_refused'] / row['n_delivered'], 1.0):.0%}".replace("%", " %"),
        n=row["n_delivered"],
        day=f"{flight[:4]}-{flight[4:6]}-{flight[6:8]}" if flight else "?",
        leg=flight[9:] if flight else "?",
        reason=row["reason"].replace("_", " "),
        file=row["file"],
    )
    return f"{said} {_('It fits {unit}.', unit=row['fits'])}" if row["fits"] else said


def _shortened(lines: list[str], where: str) -> list[str]:
    more = len(lines) - MOST
    return [*lines[:MOST], _("and {n} more: {where}", n=more, where=where)] if more > 0 else lines
