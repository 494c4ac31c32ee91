"""Load what others supply: objects of other packages by entry points, TOML that a person wrote, values of JSON."""

import tomllib
from collections.abc import Iterator
from importlib.metadata import entry_points
from typing import Any


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
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("no TOML: brackets are nested too deeply") from None
    except ValueError as error:
        raise ValueError(f"no TOML: {error}") from None


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
