"""The views' SQL and what its comments and the tables' declarations state of every column."""

import re
from collections import ChainMap
from dataclasses import dataclass
from functools import cache
from graphlib import TopologicalSorter
from importlib import resources

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


@cache
def views() -> dict[str, str]:
    """Read the SQL of every view by its file's name, each after those that its header lists under `Reads:`."""
    files = sorted((resources.files("sql") / "views").iterdir(), key=lambda file: file.name)
    sql = {f.name.removesuffix(".sql"): f.read_text() for f in files if f.name.endswith(".sql")}
    sources = {name: [s for s in read_header(text).sources if s in sql] for name, text in sql.items()}
    return {name: sql[name] for name in TopologicalSorter(sources).static_order()}


def view_headers() -> dict[str, ViewHeader]:
    """Parse the header of every view, in the order of `views`."""
    return {name: read_header(sql) for name, sql in views().items()}


def meanings_of_columns() -> dict[str, dict[str, str]]:
    """Map each view to the meanings of its columns: by its own header, else by the tables and views it reads."""
    meanings: dict[str, dict[str, str]] = {}
    for view, header in view_headers().items():
        tables = [MEANINGS[s.removeprefix("tables.")] for s in header.sources if s.startswith("tables.")]
        others = [{c: m for c, m in meanings[s].items() if m} for s in header.sources if s in meanings]
        meanings[view] = dict(ChainMap(header.columns, *tables, *others))
    return meanings


def describe_column(column: dy.Column) -> str:
    """Describe a declared column: meaning and unit."""
    metadata = column.metadata or {}
    return str(metadata.get("meaning", "")) + (f" [{metadata['unit']}]" if metadata.get("unit") else "")


MEANINGS = {t: {name: describe_column(c) for name, c in entry.schema.columns().items()} for t, entry in TABLES.items()}
"""Meaning and unit of each declared column of each table."""


def tables_read() -> list[str]:
    """List the tables that some view reads."""
    names = {t for sql in views().values() for t in re.findall(r"\btables\.(\w+)", sql)}
    return [t for t in TABLES if t in names]
