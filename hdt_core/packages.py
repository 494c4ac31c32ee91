"""What other packages bring: the objects that their entry points name."""

from collections.abc import Iterator
from importlib.metadata import entry_points
from typing import Any


def brought(group: str, what: str, error: type[Exception]) -> Iterator[tuple[str, Any]]:
    """How a message names it, and the object: of each entry point of a group; an `error` of one that fails."""
    for point in sorted(entry_points(group=group), key=lambda p: p.name):
        named = f"the {what} {point.name} ({point.value}, of the package {point.dist.name if point.dist else '?'})"
        try:
            found = point.load()
        except Exception as cause:
            raise error(f"{named} can't be loaded: {type(cause).__name__}: {cause}") from cause
        yield named, found
