"""Keep one home's cases in memory for the page, and read them again after a night, a log line or the end of a mute."""

import threading
from collections import defaultdict
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pipelines.casework.listing import list_cases
from pipelines.storage.cases import CaseLog
from pipelines.storage.catalog import catalog_version

Row = dict[str, Any]
_NEVER = datetime.max.replace(tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Cases by alert id, the most urgent first, with the log of each.

    `history` has a case's log lines, oldest first. The snapshot is valid until the next mute ends.
    """

    cases: dict[str, Row]
    history: dict[str, list[Row]]
    valid_until: datetime


class Board:
    """Share one reading of the cases among all requests; threads wait for the one that reads."""

    def __init__(self, home: Path) -> None:
        self.home, self._lock = home, threading.Lock()
        self._version: tuple[int, ...] = ()
        self._snapshot = Snapshot({}, {}, _NEVER)

    def read(self) -> Snapshot:
        """Return the present state of all cases.

        Raises
        ------
        OSError
            The catalog can't be read.
        """
        with self._lock:
            version = (*catalog_version(self.home), CaseLog(self.home).last_line())
            if version != self._version or datetime.now(UTC) >= self._snapshot.valid_until:
                self._snapshot, self._version = _read_snapshot(self.home), version
            return self._snapshot


def component_key(row: Row) -> tuple[Any, ...]:
    """Operator, tail, pack and component of a row."""
    return row["operator"], row["tail"], row["pack"], row["component"]


def _read_snapshot(home: Path) -> Snapshot:
    history, now = defaultdict(list), datetime.now(UTC)
    for row in CaseLog(home).entries().sort("line").to_dicts():
        history[row["alert_id"]].append(row)
    cases = {row["alert_id"]: row for row in list_cases(home, "true")}
    mute_ends = (c["muted_until"] for c in cases.values() if c["muted_until"] is not None)
    valid_until = min((end for end in mute_ends if end > now), default=_NEVER)
    return Snapshot(cases, dict(history), valid_until)
