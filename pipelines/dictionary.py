"""Write the data dictionary: every view and table, column by column, from declarations and view headers.

`python -m pipelines.dictionary docs/data-dictionary.md` writes it; a test compares the file.
"""

import re
import sys
import tempfile
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from hdt_core.tables import TABLES, hindsight
from hdt_core.tables.hindsight import DESIGN, REVISIONS
from pipelines.storage.catalog import connect
from pipelines.storage.headers import describe_column, find_meaning, read_header
from pipelines.storage.publication import order_views, publish, views

_TITLE = """# Data dictionary

Written by `python -m pipelines.dictionary docs/data-dictionary.md` from the declared tables (`hdt_core/tables`) and the
headers of the views (`sql/views`); change those, not this page. Times are UTC, units SI unless stated, a missing value
is NULL, never NaN. A column is explained where it first occurs; later sections name it under "As above". Columns that
differ by a number are explained once. Behind a type of a table, `?` says that it may be NULL, `0..1` its least and
greatest value. Six views to start with are in [the catalog](catalog.md); every column's meaning is also its comment
there, and `describe tables.features` lists the columns of components of your own.
"""

_TYPES = {"timestamp with time zone": "timestamptz", "datetime(time_unit='us', time_zone='utc')": "timestamptz"}


def dictionary() -> str:
    """Build the page."""
    sections: dict[str, set[tuple[str, str]]] = {}
    parts = [
        _TITLE,
        "## Views\n",
        *_views(sections),
        "## Tables\n",
        *_tables(sections),
        "## What a later night may change\n",
        *_revisions(),
    ]
    return "\n".join(parts).rstrip() + "\n"


def view_columns() -> dict[str, list[tuple[str, str, str]]]:
    """Return every view's columns as name, type and meaning with unit; the meaning may be empty."""
    with tempfile.TemporaryDirectory() as home:
        publish(Path(home))
        with connect(Path(home)) as con:
            descriptions = {v: con.sql(f"describe {v}").fetchall() for v, _ in order_views(views())}
    headers = {name: read_header(sql) for name, sql in views().items()}
    return {
        view: [(str(row[0]), str(row[1]).lower(), find_meaning(view, str(row[0]), headers)) for row in rows]
        for view, rows in descriptions.items()
    }


def _views(sections: dict[str, set[tuple[str, str]]]) -> list[str]:
    columns = view_columns()
    parts = []
    for name, sql in sorted(views().items()):
        header = read_header(sql)
        notes = f" {header.notes}" if header.notes else ""
        parts.append(f"### {name}\n\n{header.question}{notes}\n")
        parts.append(f"Grain: {header.grain}.\n")
        parts.append(_columns(name, columns[name], sections))
    return parts


def _tables(sections: dict[str, set[tuple[str, str]]]) -> list[str]:
    parts = []
    for name, entry in TABLES.items():
        parts.append(f"### tables.{name}\n\n{(entry.schema.__doc__ or '').strip()}\n")
        rows = [
            (
                column,
                f"{_type(str(c.dtype))}{'?' * c.nullable} {_span(c)}".strip(),
                describe_column(c),
            )
            for column, c in entry.schema.columns().items()
        ]
        parts.append(_columns(f"tables.{name}", rows, sections))
    return parts


def _columns(section: str, rows: Sequence[tuple[str, str, str]], sections: dict[str, set[tuple[str, str]]]) -> str:
    """Write a line for each column that no section above explains in the same words, and the names of the others.

    Neighbouring columns that differ by a number share a line, with the words of the first.
    """
    present = {(name, meaning) for name, _, meaning in rows}
    columns_above = set().union(*sections.values())
    subset = max((s for s in sections if sections[s] <= present), key=lambda s: len(sections[s]), default="")
    new_rows = [row for row in rows if (row[0], row[2]) not in columns_above]
    families = [list(group) for _, group in groupby(new_rows, key=_family)]
    lines = [
        f"- {', '.join(f'`{name}`' for name, _, _ in group)} ({_type(group[0][1])}): {group[0][2].removesuffix(' [-]')}"
        for group in families
    ]
    by_name = columns_above - sections.get(subset, set())
    names = [f"all of `{subset}`"] * bool(subset)
    names += [f"`{name}`" for name, _, meaning in rows if (name, meaning) in by_name]
    sections[section] = present
    return "\n".join([*lines, *([f"- As above: {', '.join(names)}"] if names else [])]) + "\n"


def _family(row: tuple[str, str, str]) -> tuple[str, ...]:
    """Return the key of columns with the same meaning, or with names that differ by a number."""
    name, kind, meaning = row
    bare = re.sub(r"\d+", "", meaning)
    return (kind, meaning) if bare == meaning else (kind, bare, re.sub(r"\d+", "", name))


def _type(kind: str) -> str:
    return _TYPES.get(kind.lower(), kind.lower())


def _revisions() -> list[str]:
    """List what later nights may change."""
    rows = [(", ".join(f"`{t}`" for t in r.tables), ", ".join(f"`{n}`" for n in r.names), r.why) for r in REVISIONS]
    return [f"{hindsight.__doc__}\n{DESIGN}\n", _table(("table or view", "column or parameter", "why"), rows)]


def _span(column: Any) -> str:
    """Return least and greatest value, or the pattern of a text."""
    low, high, pattern = (getattr(column, name, None) for name in ("min", "max", "regex"))
    if pattern:
        return f"`{pattern}`"
    if low is None and high is None:
        return ""
    return f"{'' if low is None else f'{low:g}'}..{'' if high is None else f'{high:g}'}"


def _table(names: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [names, tuple("---" for _ in names), *(tuple(c.replace("|", "\\|") for c in row) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(dictionary(), encoding="utf-8")
