"""Write the data dictionary: every view and table, column by column, from declarations and view headers.

`python -m docs.dictionary docs/data-dictionary.md` writes it; a test compares the file.
"""

import re
import sys
import tempfile
from collections.abc import Sequence
from functools import cache
from itertools import groupby
from pathlib import Path

from docs import hindsight
from docs.hindsight import DESIGN, REVISIONS
from hdt_core.tables import TABLES
from pipelines.storage.catalog import connect
from pipelines.storage.publication import publish
from pipelines.storage.view_headers import meanings_of_columns, read_header, views

_TITLE = """# Data dictionary

Written by `python -m docs.dictionary docs/data-dictionary.md` from the declared tables (`hdt_core/tables`) and
the headers of the views (`sql/views`). Times are UTC, units SI unless stated, a missing value is NULL. Each column is
explained where it first occurs; later sections name it under "As above". Columns that differ by a number or by the
column they describe (`*`) share a line. `x_sd` is the standard deviation of `x`, `x_status` how its estimate ended. A
column without a type is a `double`; a `bigint` where its name begins with `n_`, a `timestamptz` where it ends in
`_at`, a `date` in `_on`, a `varchar` in `_id` or `status`. Columns of tables and of components of your own are
explained in the catalog (`select column_name, comment from duckdb_columns() where table_name = 'twin_flights'`).
"""
_KEYS = ("operator", "tail", "flight_id", "pack", "component", "departed_at", "departed_on")
"""Columns of the view `prognoses` that most views and tables have: explained once, on top."""
_DESCRIBES = re.compile(r"^.*(?=_(?:lost_share|still|n)$)")
_SIDES = re.compile(r"(?:dsm|sensor)_minus_(?:dsm|twin)")
_BY_NAME = re.compile(r"(standard deviation of it|its standard deviation|how that estimate ended)( \[.*\])?$")
_TYPES = {"timestamp with time zone": "timestamptz"}
_IMPLIED = (("bigint", "^n_"), ("timestamptz", "_at$"), ("date", "_on$"), ("varchar", "status$|_id$"))
"""Types that a name implies, and the names."""


def dictionary() -> str:
    """Build the page."""
    sections: dict[str, set[tuple[str, str]]] = {}
    parts = [
        _TITLE,
        "## Keys, wherever they occur\n",
        _columns("keys", [row for row in view_columns()["prognoses"] if row[0] in _KEYS], sections),
        "## Views\n",
        *_views(sections),
        "## Tables\n",
        _tables(),
        "## What a later night may change\n",
        *_revisions(),
    ]
    return "\n".join(parts).rstrip() + "\n"


@cache
def view_columns() -> dict[str, list[tuple[str, str, str]]]:
    """Return every view's columns as name, type and meaning with unit; the meaning may be empty."""
    with tempfile.TemporaryDirectory() as home:
        publish(Path(home))
        with connect(Path(home)) as con:
            descriptions = {v: con.sql(f"describe {v}").fetchall() for v in views()}
    meanings = meanings_of_columns()
    return {
        view: [(str(row[0]), str(row[1]).lower(), meanings[view].get(str(row[0]), "")) for row in rows]
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
        parts.append(_columns(name, [row for row in columns[name] if row[0] not in _KEYS], sections))
    return parts


def _tables() -> str:
    """Say what a row of each table is, a line for tables that share it."""
    names: dict[str, list[str]] = {}
    for name, entry in TABLES.items():
        names.setdefault((entry.schema.__doc__ or "").strip(), []).append(f"`tables.{name}`")
    return "".join(f"- {', '.join(tables)}: {meaning}\n" for meaning, tables in names.items())


def _columns(section: str, rows: Sequence[tuple[str, str, str]], sections: dict[str, set[tuple[str, str]]]) -> str:
    """Write a line for each column that no section above explains in the same words, and the names of the others."""
    present = {(name, meaning) for name, _, meaning in rows}
    columns_above = set().union(*sections.values())
    subset = max((s for s in sections if sections[s] <= present), key=lambda s: len(sections[s]), default="")
    new_rows = [row for row in rows if (row[0], row[2]) not in columns_above and not _BY_NAME.match(row[2])]
    families = [list(group) for _, group in groupby(new_rows, key=_family)]
    lines = [
        f"- {_names(group)}{_stated_type(*group[0][:2])}: "
        + (group[0][2] if len(group) == 1 else _generalise(*group[0][::2])[1]).removesuffix(" [-]")
        for group in families
    ]
    by_name = columns_above - sections.get(subset, set())
    names = [f"all of `{subset}`"] * bool(subset)
    names += [f"`{name}`" for name, _, meaning in rows if (name, meaning) in by_name]
    sections[section] = present
    return "\n".join([*lines, *([f"- As above: {', '.join(names)}"] if names else [])]) + "\n"


def _names(group: Sequence[tuple[str, str, str]]) -> str:
    """Name the columns of a family; those that describe each recorded signal by their ending."""
    names = [name for name, _, _ in group]
    stems = {_DESCRIBES.sub("*", name) for name in names}
    return ", ".join(f"`{name}`" for name in (stems if len(stems) == 1 < len(names) else names))


def _family(row: tuple[str, str, str]) -> tuple[str, ...]:
    """Return the key of columns with the same meaning, or that differ by a number or by the column they describe."""
    name, kind, meaning = row
    stem, general = _generalise(name, meaning)
    if general == meaning and re.sub(r"\d+", "", meaning) == meaning:
        return kind, meaning
    return kind, re.sub(r"\d+", "", general), re.sub(r"\d+", "", stem)


def _generalise(name: str, meaning: str) -> tuple[str, str]:
    """Put `*` for the column that another one describes, and for the two sides of a residual."""
    stem = _DESCRIBES.sub("*", name)
    if stem != name:
        return stem, meaning.replace(name.removesuffix(stem[1:]), "*")
    return _SIDES.sub("*", name), re.sub(r": \w+ less \w+", ": what the names say", meaning)


def _stated_type(name: str, kind: str) -> str:
    """Return the type in brackets where the name does not imply it."""
    kind = _TYPES.get(kind, kind)
    return "" if kind == next((k for k, pattern in _IMPLIED if re.search(pattern, name)), "double") else f" ({kind})"


def _revisions() -> list[str]:
    """List what later nights may change."""
    rows = [(", ".join(f"`{t}`" for t in r.tables), ", ".join(f"`{n}`" for n in r.names), r.why) for r in REVISIONS]
    return [f"{hindsight.__doc__}\n{DESIGN}\n", _table(("table or view", "column or parameter", "why"), rows)]


def _table(names: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [names, tuple("---" for _ in names), *(tuple(c.replace("|", "\\|") for c in row) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(dictionary(), encoding="utf-8")
