"""TOML that a person wrote, read so that whatever is wrong with it is one line."""

import tomllib
from typing import Any


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
