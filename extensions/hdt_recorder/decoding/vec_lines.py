"""Lines of a ground station's export: a number, `|`, and fields between tabs, in UTF-16."""

import re
from collections.abc import Callable, Iterator
from typing import TypeVar

from hdt_recorder.decoding.layout import MapError

T = TypeVar("T")
Line = tuple[int, str, list[str]]
"""Number of the line, its kind, its fields."""


def read_lines(name: str, data: bytes) -> Iterator[Line]:
    """Number, kind and fields of each line that has a kind; comments and the rest of a long text have none."""
    coding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = data.decode(coding)
    except UnicodeError:
        raise MapError(f"{name}: no text of a ground station's export") from None
    for number, line in enumerate(text.splitlines(), 1):
        if match := re.match(r"(\d+)\|(.*)", line):
            yield number, match[1], match[2].split("\t")


def read_row(name: str, row: tuple[int, list[str]], read: Callable[[list[str]], T]) -> T:
    """What `read` makes of a line's number and fields; a `MapError` that names file and line if it can't."""
    try:
        return read(row[1])
    except (ValueError, IndexError) as error:
        raise MapError(f"{name}: line {row[0]}: {error}") from None
