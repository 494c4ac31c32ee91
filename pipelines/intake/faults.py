"""Describe faults of delivered files, rows and values, and turn them into quarantine rows."""

import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from importlib.resources import files
from typing import NamedTuple

import polars as pl

from hdt_core.tables.raw import RawQuarantine

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
        scope, sentence, _ = REASONS[f.reason]
        detail, content = f"{sentence} {f.detail}".strip(), f.content and f.content[:500]
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
