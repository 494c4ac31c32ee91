"""Check delivered names: operators, tails, flights, files of the contract."""

import re
from datetime import date

from hdt_core.tables.base import FLIGHT_ID, OPERATOR, TAIL

MAX_PACKS = 4
EARLIEST = date(1980, 1, 7)
"""A clock that was never set gives 1970, or 6 January 1980 where it is GPS; an older date is a typing error."""
_OPERATOR, _TAIL, _FLIGHT_ID = (re.compile(p, re.ASCII) for p in (OPERATOR, TAIL, FLIGHT_ID))
_HISTORY = re.compile(r"history_\d{4}-\d{2}\.parquet", re.ASCII)


def is_operator(name: str) -> bool:
    """Return whether `name` is that of an operator."""
    return _OPERATOR.fullmatch(name) is not None


def is_tail(name: str) -> bool:
    """Return whether `name` is a registration."""
    return _TAIL.fullmatch(name) is not None


def is_history(name: str) -> bool:
    """Return whether `name` is that of a history file."""
    return _HISTORY.fullmatch(name) is not None


def flight_day(flight_id: str) -> date | None:
    """Parse the UTC day of departure of a flight_id; None where it is none: bad pattern, no such day, leg 00.

    Examples
    --------
    >>> flight_day("LX-AAA_20240229_01")
    datetime.date(2024, 2, 29)
    >>> flight_day("LX-AAA_20230229_01"), flight_day("../X_20240101_01"), flight_day("LX-AAA_20240101_00")
    (None, None, None)
    """
    if _FLIGHT_ID.fullmatch(flight_id) is None or flight_id.endswith("_00"):
        return None
    digits = flight_id[-11:-3]
    try:
        return date(int(digits[:4]), int(digits[4:6]), int(digits[6:]))
    except ValueError:
        return None


def flight_tail(flight_id: str) -> str:
    """Return the tail of a well-formed flight_id."""
    return flight_id[:-12]


def flight_of_file(name: str, tail: str) -> str | None:
    """Return the flight that a file is named after; None where the name is no flight_id of this tail."""
    stem = name.rpartition(".")[0]
    return stem if flight_day(stem) is not None and flight_tail(stem) == tail else None
