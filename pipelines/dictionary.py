"""The data dictionary: every view and table, column by column, from the declarations and the headers of the views.

`python -m pipelines.dictionary docs/data-dictionary.md` writes it; a test holds the file to it.
"""

import re
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hdt_core.tables import TABLES
from pipelines.catalog import connect, ordered, publish, views

_TITLE = """# Data dictionary

Written by `python -m pipelines.dictionary docs/data-dictionary.md` from the declared tables (`hdt_core/tables`) and the
headers of the views (`sql/views`); change those, not this page. All times are UTC, all units SI unless the unit says
otherwise; what is missing is NULL, never NaN. A table marked *open* keeps further columns that its stage adds:
`describe tables.features` lists what a catalog holds.
"""
_COLUMN = re.compile(r"^([a-z][a-z0-9_]*): (.*)")
_OTHER = re.compile(r"^(Grain|Reads): (.*)")


@dataclass(frozen=True, slots=True)
class Header:
    """What the comment on top of a view says: the question, and of the columns it makes itself what they mean."""

    question: str
    notes: str
    grain: str
    reads: tuple[str, ...]
    columns: dict[str, str]


def read_header(sql: str) -> Header:
    """Header of a view: its first sentence asks, `name: meaning` explains a column, `Grain:` and `Reads:` end it."""
    question, *lines = [line.removeprefix("--").strip() for line in sql.splitlines() if line.startswith("--")]
    said: dict[str, list[str]] = {"": []}
    key = ""
    for line in re.sub(r"(Reads:)", r"\n\1", "\n".join(lines)).splitlines():
        found = _COLUMN.match(line) or _OTHER.match(line)
        if found:
            key = found.group(1)
        said.setdefault(key, []).append(found.group(2) if found else line)
    text = {k: " ".join(v).strip() for k, v in said.items()}
    reads = tuple(r.strip() for r in text.pop("Reads", "").rstrip(".").split(",") if r.strip())
    return Header(question, text.pop(""), text.pop("Grain", "").rstrip("."), reads, text)


def dictionary() -> str:
    """The page."""
    parts = [_TITLE, "## Views\n", *_views(), "## Tables\n", *_tables()]
    return "\n".join(parts).rstrip() + "\n"


def view_columns() -> dict[str, list[tuple[str, str, str]]]:
    """Of every view its columns as name, type and meaning with unit; the meaning is empty where nothing says it."""
    with tempfile.TemporaryDirectory() as home:
        publish(Path(home))
        with connect(Path(home)) as con:
            described = {v: con.sql(f"describe {v}").fetchall() for v, _ in ordered(views())}
    known = {name: read_header(sql) for name, sql in views().items()}
    return {
        view: [(str(row[0]), str(row[1]).lower(), _meaning(view, str(row[0]), known)) for row in rows]
        for view, rows in described.items()
    }


def _meaning(view: str, column: str, known: dict[str, Header]) -> str:
    """What the view says of a column, else what the views and tables it reads say, else any table."""
    header = known[view]
    if column in header.columns:
        return header.columns[column]
    tables = [r.removeprefix("tables.") for r in header.reads if r.startswith("tables.")]
    for table in tables:
        if column in TABLES[table].schema.columns():
            return _declared(table, column)
    for other in header.reads:
        if other in known and (found := _meaning(other, column, known)):
            return found
    return ""


def _declared(table: str, column: str) -> str:
    metadata: dict[str, Any] = TABLES[table].schema.columns()[column].metadata or {}
    unit = metadata.get("unit")
    return metadata.get("meaning", "") + (f" [{unit}]" if unit else "")


def _views() -> list[str]:
    columns = view_columns()
    parts = []
    for name, sql in sorted(views().items()):
        header = read_header(sql)
        notes = f" {header.notes}" if header.notes else ""
        parts.append(f"### {name}\n\n{header.question}{notes}\n")
        parts.append(f"Grain: {header.grain}. Reads: {', '.join(f'`{r}`' for r in header.reads)}.\n")
        rows = [(f"`{column}`", kind, meaning) for column, kind, meaning in columns[name]]
        parts.append(_table(("column", "type", "meaning"), rows))
    return parts


def _tables() -> list[str]:
    parts = []
    for name, entry in TABLES.items():
        opened = " Open." if entry.open else ""
        grain = {"flight": "a flight of an aircraft", "aircraft": "an aircraft", "fleet": "the fleet"}[entry.grain]
        parts.append(f"### tables.{name}\n\n{(entry.schema.__doc__ or '').strip()} Computed by {grain}.{opened}\n")
        rows = [
            (f"`{column}`", str(c.dtype).lower(), _span(c), "yes" if c.nullable else "no", _declared(name, column))
            for column, c in entry.schema.columns().items()
        ]
        parts.append(_table(("column", "type", "span", "null", "meaning"), rows))
    return parts


def _span(column: Any) -> str:
    """Least and greatest value, or the pattern of a text."""
    low, high, pattern = (getattr(column, name, None) for name in ("min", "max", "regex"))
    if pattern:
        return f"`{pattern}`"
    if low is None and high is None:
        return ""
    return f"{'' if low is None else f'{low:g}'} to {'' if high is None else f'{high:g}'}".strip()


def _table(names: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [names, tuple("---" for _ in names), *(tuple(c.replace("|", "\\|") for c in row) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(dictionary(), encoding="utf-8")
