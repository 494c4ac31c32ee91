"""What views and columns mean: headers of the views, declarations of the tables."""

import re
from dataclasses import dataclass

import dataframely as dy

from hdt_core.tables import TABLES

_COLUMN = re.compile(r"^([a-z][a-z0-9_]*): (.*)")
_OTHER = re.compile(r"^(Grain|Reads): (.*)")


@dataclass(frozen=True, slots=True)
class ViewHeader:
    """What the comment on top of a view says: the question, and of the columns it makes itself what they mean."""

    question: str
    notes: str
    grain: str
    reads: tuple[str, ...]
    columns: dict[str, str]


def read_header(sql: str) -> ViewHeader:
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
    return ViewHeader(question, text.pop(""), text.pop("Grain", "").rstrip("."), reads, text)


def meaning(view: str, column: str, known: dict[str, ViewHeader]) -> str:
    """What the view says of a column, else what the views and tables it reads say, else any table."""
    header = known[view]
    if column in header.columns:
        return header.columns[column]
    tables = [r.removeprefix("tables.") for r in header.reads if r.startswith("tables.")]
    for table in tables:
        if column in MEANINGS[table]:
            return MEANINGS[table][column]
    for other in header.reads:
        if other in known and (found := meaning(other, column, known)):
            return found
    return ""


def declared(column: dy.Column) -> str:
    """What a declared column means, with its unit."""
    said = column.metadata or {}
    return str(said.get("meaning", "")) + (f" [{said['unit']}]" if said.get("unit") else "")


MEANINGS = {t: {name: declared(c) for name, c in entry.schema.columns().items()} for t, entry in TABLES.items()}
"""What each declared column of each table means, with its unit."""
