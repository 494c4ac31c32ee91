"""All cases of a home as a page shows them to many at once, read again only where something has changed."""

import threading
from collections import defaultdict
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pipelines.casework.listing import list_cases, outlooks
from pipelines.storage.cases import CaseLog
from pipelines.storage.catalog import CATALOG

Row = dict[str, Any]
Place = tuple[Any, ...]
_PLACE = ("operator", "tail", "pack", "component")
_NEVER = datetime.max.replace(tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Outlook:
    """When the message of each component is due, and the choices at the next stop, the best first: as of a night."""

    due: dict[Place, Row]
    choices: dict[Place, list[Row]]

    def of(self, case: Row) -> tuple[Row | None, list[Row]]:
        """Both for the component of a case."""
        place = _place(case)
        return self.due.get(place), self.choices.get(place, [])


@dataclass(frozen=True, slots=True)
class Standing:
    """How every case stands, the most urgent first, and the lines of the log about each, the oldest first."""

    cases: dict[str, Row]
    history: dict[str, list[Row]]
    outlook: Outlook
    ends_at: datetime
    """When the next mute ends."""


class Board:
    """Reads a home's cases for all who ask, one after the other; a night, a line or the end of a mute renews them."""

    def __init__(self, home: Path) -> None:
        self.home, self._lock = home, threading.Lock()
        self._night: tuple[int, int] | None = None
        self._line = 0
        self._standing = Standing({}, {}, Outlook({}, {}), _NEVER)

    def read(self) -> Standing:
        """How all cases stand now.

        Raises
        ------
        OSError
            The catalog can't be read.
        """
        with self._lock:
            file, line = (self.home / CATALOG).stat(), CaseLog(self.home).last_line()
            night, held = (file.st_ino, file.st_mtime_ns), self._standing
            if (night, line) != (self._night, self._line) or datetime.now(UTC) >= held.ends_at:
                outlook = held.outlook if night == self._night else _outlook(self.home)
                self._standing, self._night, self._line = _standing(self.home, outlook), night, line
            return self._standing


def _standing(home: Path, outlook: Outlook) -> Standing:
    history, now = defaultdict(list), datetime.now(UTC)
    for row in CaseLog(home).entries().sort("line").to_dicts():
        history[row["alert_id"]].append(row)
    cases = {row["alert_id"]: row for row in list_cases(home, "true")}
    ends = (c["muted_until"] for c in cases.values() if c["muted_until"] is not None)
    return Standing(cases, dict(history), outlook, min((at for at in ends if at > now), default=_NEVER))


def _outlook(home: Path) -> Outlook:
    choices, (due, rows) = defaultdict(list), outlooks(home)
    for row in rows:
        choices[_place(row)].append(row)
    return Outlook({_place(row): row for row in due}, dict(choices))


def _place(row: Row) -> Place:
    return tuple(row[c] for c in _PLACE)
