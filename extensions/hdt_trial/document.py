"""A plain offline document: headings, paragraphs and tables, nothing fetched, no script; it prints as it stands."""

from collections.abc import Iterable, Sequence
from typing import Any

from pipelines.report.templating import policy, render

Part = dict[str, Any] | str
"""Content of a section; text is a paragraph. `document.html` renders each kind."""


def document(title: str, *parts: Part) -> str:
    """Render the document as HTML."""
    return render("document.html", title=title, parts=parts, policy=policy())


def section(title: str, *parts: Part | None) -> Part:
    """Return a section under a heading."""
    return {"kind": "section", "title": title, "parts": [p for p in parts if p is not None]}


def heading(title: str) -> Part:
    """Return a subheading."""
    return {"kind": "heading", "text": title}


def table(columns: Sequence[str], rows: Iterable[Sequence[Any]], empty: str = "None.") -> Part:
    """Return a table, or a sentence where it has no row."""
    body = list(rows)
    return {"kind": "table", "columns": columns, "rows": body} if body else empty


def bullets(items: Iterable[Any]) -> Part:
    """Return a list."""
    return {"kind": "bullets", "items": list(items)}


def verbatim(text: str) -> Part:
    """Return preformatted text."""
    return {"kind": "verbatim", "text": text}


def code(text: str) -> Part:
    """Return code within a cell."""
    return {"kind": "code", "text": text}
