"""Values as JSON returns them."""

from typing import Any


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
