"""A plain offline document: headings, paragraphs and tables, nothing fetched, no script; it prints as it stands."""

from collections.abc import Iterable, Sequence
from typing import Any

from pipelines.report.html import Html, join, tag

_POLICY = "default-src 'none'; style-src 'unsafe-inline'"
_STYLE = """
:root { color-scheme: light dark; }
body { max-width: 60rem; margin: 0 auto; padding: 1rem; font: 16px/1.45 system-ui, sans-serif; }
h2 { margin-top: 2rem; border-top: 2px solid; padding-top: .5rem; font-size: 1.25rem; }
table { border-collapse: collapse; width: 100%; font-size: .9rem; margin-bottom: 1rem; }
th, td { padding: .3rem .5rem; text-align: left; vertical-align: top; border-bottom: 1px solid #8886; }
th { border-bottom: 2px solid; }
code, pre { font-size: .85rem; white-space: pre-wrap; }
@media print { body { max-width: none; font-size: 10pt; } tr { break-inside: avoid; } }
"""


def document(title: str, *parts: Any) -> str:
    """The whole document."""
    head = join(
        Html('<meta charset="utf-8">'),
        Html('<meta name="viewport" content="width=device-width, initial-scale=1">'),
        Html(f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'),
        Html('<link rel="icon" href="data:,">'),
        tag("title", title),
        tag("style", Html(_STYLE)),
    )
    body = join(tag("h1", title), *parts)
    return f'<!doctype html>\n<html lang="en"><head>{head}</head><body>{body}</body></html>\n'


def section(title: str, *parts: Any) -> Html:
    """A heading and what stands under it; text is a paragraph."""
    return tag(
        "section", tag("h2", title), *(p if isinstance(p, Html) else tag("p", p) for p in parts if p is not None)
    )


def table(columns: Sequence[str], rows: Iterable[Sequence[Any]], empty: str = "None.") -> Html:
    """A table; a sentence where it has no row."""
    body = [tag("tr", *(tag("td", "" if cell is None else cell) for cell in row)) for row in rows]
    if not body:
        return tag("p", empty)
    return tag("table", tag("thead", tag("tr", *(tag("th", c) for c in columns))), tag("tbody", *body))


def bullets(items: Iterable[Any]) -> Html:
    """A list."""
    return tag("ul", *(tag("li", item) for item in items))
