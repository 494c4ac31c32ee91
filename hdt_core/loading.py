"""Load what others supply: objects of other packages by entry points, TOML that a person wrote, values of JSON."""

import os
import tomllib
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

MAX_BYTES = 1_000_000
"""Limit of a file that a person wrote. [bytes]"""
MAX_DEPTH = 64
"""Limit of tables and lists within each other; whatever walks through a document calls itself as often."""
MAX_KEY = 200
"""Limit of a key. [characters]"""
MAX_BITS = 2_000
"""Limit of a whole number; Python prints none of 4,300 digits. [bits]"""
MAX_KEY_STEPS = 4_000_000
"""Limit of the dots of a line times the lines: tomllib's time grows with both. Two seconds."""


class UserError(Exception):
    """An error that a user can correct; its message is one line without a secret."""


def load_entry_points(group: str, kind: str, error: type[Exception]) -> Iterator[tuple[str, Any]]:
    """Load each entry point of a group; yield its label for messages and the object, raise `error` where it fails."""
    for point in sorted(entry_points(group=group), key=lambda p: p.name):
        label = f"the {kind} {point.name} ({point.value}, of the package {point.dist.name if point.dist else '?'})"
        try:
            loaded = point.load()
        except Exception as cause:
            raise error(f"{label} can't be loaded: {type(cause).__name__}: {cause}") from cause
        yield label, loaded


def read_text(file: Path) -> str:
    """Return the text of a file that a person wrote, without the byte order mark of Notepad.

    Raises
    ------
    FileNotFoundError
        Nothing has this name.
    OSError
        It can't be read.
    ValueError
        It is a folder, a pipe, a device or a link to nothing, is longer than `MAX_BYTES`, or no UTF-8.
    """
    if os.path.lexists(file) and not file.is_file():
        raise ValueError("it is no regular file")
    with file.open("rb") as source:
        content = source.read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise ValueError(f"it has more than {MAX_BYTES} bytes")
    return content.decode("utf-8-sig")


def parse_toml(text: str) -> dict[str, Any]:
    """Return the tables of a text.

    Raises
    ------
    ValueError
        It is no TOML, or is nested deeper, or holds a longer number, than Python reads.

    Examples
    --------
    >>> parse_toml("keep_days = 30")
    {'keep_days': 30}
    """
    lines = text.split("\n")
    most_dots = max(line.count(".") for line in lines)
    if most_dots * max(most_dots, len(lines)) > MAX_KEY_STEPS:
        raise ValueError("no TOML: too many dots in a line")
    try:
        document = tomllib.loads(text)
    except RecursionError:
        raise ValueError("no TOML: brackets are nested too deeply") from None
    except ValueError as error:
        raise ValueError(f"no TOML: {error}") from None
    _check_size(document)
    return document


def _check_size(document: dict[str, Any]) -> None:
    """Raise a `ValueError` where a document is too deep to walk through, or a key or number too long to show."""
    values: list[Any] = [document]
    for _ in range(MAX_DEPTH):
        if any(isinstance(value, int) and value.bit_length() > MAX_BITS for value in values):
            raise ValueError("no TOML: a number has too many digits")
        if any(not _is_name(name) for value in values if isinstance(value, dict) for name in value):
            raise ValueError("no TOML: a key has a control character or is too long")
        containers = [v.values() if isinstance(v, dict) else v for v in values if isinstance(v, dict | list)]
        values = [inner for container in containers for inner in container]
    if values:
        raise ValueError("no TOML: tables or lists are nested too deeply")


def _is_name(key: str) -> bool:
    """Test that a key can be shown in a message of one line."""
    return key.isprintable() and len(key) <= MAX_KEY


def with_tuples(value: Any) -> Any:
    """Convert lists, at whatever depth, to tuples.

    Examples
    --------
    >>> with_tuples({"rows": [[1, 2], [3]], "name": "x"})
    {'rows': ((1, 2), (3,)), 'name': 'x'}
    """
    if isinstance(value, dict):
        return {name: with_tuples(entry) for name, entry in value.items()}
    return tuple(map(with_tuples, value)) if isinstance(value, list) else value
