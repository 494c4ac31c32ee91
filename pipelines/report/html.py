"""Markup that can't be broken into: whatever is not markup already is escaped on its way in."""

import re
from html import escape
from typing import Any

# control characters and those that turn the direction of text: a name must not reorder the sentence it stands in
_HIDDEN = re.compile("[\x00-\x08\x0b-\x1f\x7f\u200e\u200f\u202a-\u202e\u2066-\u2069\ufffe\uffff]")


class Html(str):
    """Text that is markup already."""

    __slots__ = ()


def text(value: Any) -> Html:
    """`value` as it may stand between tags or in a quoted attribute."""
    return value if isinstance(value, Html) else Html(escape(_HIDDEN.sub("\ufffd", str(value)), quote=True))


def join(*parts: Any, by: str = "") -> Html:
    """Parts in a row, those that are not markup escaped; None is nothing."""
    return Html(by.join(text(p) for p in parts if p is not None))


def tag(name: str, *children: Any, **attributes: Any) -> Html:
    """`<name attributes>children</name>`; `class_` is class, `data_find` is data-find, None leaves an attribute out."""
    given = "".join(f' {k.rstrip("_").replace("_", "-")}="{text(v)}"' for k, v in attributes.items() if v is not None)
    return Html(f"<{name}{given}>{join(*children)}</{name}>")


def anchor(*parts: Any) -> str:
    """An id made of `parts`, the same wherever it is asked for."""
    return re.sub(r"[^A-Za-z0-9]+", "-", "-".join(str(p) for p in parts)).strip("-")
