"""A plain offline document: headings, paragraphs and tables, nothing fetched, no script; it prints as it stands."""

from collections.abc import Iterable, Sequence
from typing import Any

from pipelines.report.templating import policy, render

Part = dict[str, Any] | str
"""What stands in a section; text is a paragraph. `document.html` says how each kind looks."""


def document(title: str, *parts: Part) -> str:
    """The whole document."""
    return render("document.html", title=title, parts=parts, policy=policy())


def section(title: str, *parts: Part | None) -> Part:
    """A heading and what stands under it."""
    return {"kind": "section", "title": title, "parts": [p for p in parts if p is not None]}


def heading(title: str) -> Part:
    """A smaller heading."""
    return {"kind": "heading", "text": title}


def table(columns: Sequence[str], rows: Iterable[Sequence[Any]], empty: str = "None.") -> Part:
    """A table; a sentence where it has no row."""
    body = list(rows)
    return {"kind": "table", "columns": columns, "rows": body} if body else empty


def bullets(items: Iterable[Any]) -> Part:
    """A list."""
    return {"kind": "bullets", "items": list(items)}


def verbatim(text: str) -> Part:
    """Text as it was written."""
    return {"kind": "verbatim", "text": text}


def code(text: str) -> Part:
    """Text for a machine, within a cell."""
    return {"kind": "code", "text": text}
