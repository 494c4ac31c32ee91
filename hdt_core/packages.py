"""Load objects of other packages by entry points."""

from collections.abc import Iterator
from importlib.metadata import entry_points
from typing import Any


def load_entry_points(group: str, kind: str, error: type[Exception]) -> Iterator[tuple[str, Any]]:
    """Load each entry point of a group; yield its label for messages and the object, raise `error` where it fails."""
    for point in sorted(entry_points(group=group), key=lambda p: p.name):
        label = f"the {kind} {point.name} ({point.value}, of the package {point.dist.name if point.dist else '?'})"
        try:
            loaded = point.load()
        except Exception as cause:
            raise error(f"{label} can't be loaded: {type(cause).__name__}: {cause}") from cause
        yield label, loaded
