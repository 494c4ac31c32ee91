"""Read the meaning of views and columns: headers of the views, declarations of the tables."""

import re
from collections import ChainMap
from dataclasses import dataclass
from graphlib import TopologicalSorter

import dataframely as dy

from hdt_core.tables import TABLES

_COLUMN = re.compile(r"^([a-z][a-z0-9_]*): (.*)")
_OTHER = re.compile(r"^(Grain|Reads): (.*)")


@dataclass(frozen=True, slots=True)
class ViewHeader:
    """Comment on top of a view: its question, its grain and the meaning of the columns that it computes."""

    question: str
    notes: str
    grain: str
    sources: tuple[str, ...]
    columns: dict[str, str]


def read_header(sql: str) -> ViewHeader:
    """Parse a view's header: first the question, `name: meaning` for a column, `Grain:` and `Reads:` at the end."""
    question, *lines = [line.removeprefix("--").strip() for line in sql.splitlines() if line.startswith("--")]
    parts: dict[str, list[str]] = {"": []}
    key = ""
    for line in re.sub(r"(Reads:)", r"\n\1", "\n".join(lines)).splitlines():
        match = _COLUMN.match(line) or _OTHER.match(line)
        if match:
            key = match.group(1)
        parts.setdefault(key, []).append(match.group(2) if match else line)
    text = {k: " ".join(v).strip() for k, v in parts.items()}
    sources = tuple(r.strip() for r in text.pop("Reads", "").rstrip(".").split(",") if r.strip())
    return ViewHeader(question, text.pop(""), text.pop("Grain", "").rstrip("."), sources, text)


def meanings_of_columns(headers: dict[str, ViewHeader]) -> dict[str, dict[str, str]]:
    """Map each view to the meanings of its columns: by its own header, else by the tables and views it reads."""
    meanings: dict[str, dict[str, str]] = {}
    for view in TopologicalSorter({v: set(h.sources) & set(headers) for v, h in headers.items()}).static_order():
        tables = [MEANINGS[s.removeprefix("tables.")] for s in headers[view].sources if s.startswith("tables.")]
        views = [{c: m for c, m in meanings[s].items() if m} for s in headers[view].sources if s in headers]
        meanings[view] = dict(ChainMap(headers[view].columns, *tables, *views))
    return meanings


def describe_column(column: dy.Column) -> str:
    """Describe a declared column: meaning and unit."""
    metadata = column.metadata or {}
    return str(metadata.get("meaning", "")) + (f" [{metadata['unit']}]" if metadata.get("unit") else "")


MEANINGS = {t: {name: describe_column(c) for name, c in entry.schema.columns().items()} for t, entry in TABLES.items()}
"""Meaning and unit of each declared column of each table."""
