"""What changed between two states: alerts, outlooks that left their own interval, gaps, silence, refused files."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hdt_core.prognosis.model import HORIZON
from pipelines.digest.state import EMPTY, State, read_state
from pipelines.storage.catalog import connect
from pipelines.storage.ledger import Ledger
from pipelines.storage.publication import connect_as_of

Row = dict[str, Any]
_URGENCY, _SEVERITY = ("none", "plan", "act"), ("low", "medium", "high")
KINDS = ("new", "worse", "closed", "moved", "eased", "silent", "gap", "refused")
"""In the order in which they are told."""


@dataclass(frozen=True, slots=True)
class Digest:
    """Changes between two nights.

    Attributes
    ----------
    since, until : str or None
        Last departure on record then and now (UTC); None where there was none.
    changes : dict of str to list of dict
        By kind, see `KINDS`; a kind without a change is not there. A row says `operator`, `tail` (both may be null of a
        file) and what its kind needs; `was` is the row of the earlier state.
    """

    since: str | None
    until: str | None
    changes: dict[str, list[Row]]

    @property
    def empty(self) -> bool:
        """Nothing changed."""
        return not self.changes

    def of(self, operator: str | None) -> "Digest":
        """What one operator may see; all with None."""
        if operator is None:
            return self
        own = {k: [r for r in rows if r["operator"] == operator] for k, rows in self.changes.items()}
        return replace(self, changes={k: rows for k, rows in own.items() if rows})


def changes_since(home: Path, night: str | None = None) -> Digest:
    """What changed since the last night at or before `night`; since the last but one, where none is named.

    Raises
    ------
    StoreError
        There was no night by then, or it is not kept any more.
    """
    with connect(home) as con:
        now = read_state(con)
    nights = sorted(Ledger(home, looks=True).snapshots())
    if night is None and len(nights) < 2:
        return compare(EMPTY, now)
    with connect_as_of(home, night or nights[-2]) as con:
        return compare(read_state(con), now)


def compare(before: State, now: State) -> Digest:
    """What has changed; an alert that came and went in between is not told of."""
    pairs = [(before["alerts"][name], row) for name, row in now["alerts"].items() if name in before["alerts"]]
    found = {
        "new": [row for name, row in now["alerts"].items() if name not in before["alerts"]],
        "worse": [row | {"was": was} for was, row in pairs if _weight(row) > _weight(was)],
        "closed": [_closed(was, now) for name, was in before["alerts"].items() if name not in now["alerts"]],
        "moved": list(_moved(before["outlook"], now["outlook"])),
        "eased": [row | {"was": was} for was, row in pairs if _weight(row) < _weight(was)],
        "silent": [row for name, row in now["silent"].items() if name not in before["silent"]],
        "gap": [row for name, row in now["gaps"].items() if name not in before["gaps"]],
        "refused": [row for name, row in now["files"].items() if before["files"].get(name) != row],
    }
    told = {kind: sorted(rows, key=_place) for kind in KINDS if (rows := found[kind])}
    return Digest(before["until"], now["until"], told)


def _weight(alert: Row) -> tuple[int, int]:
    return _URGENCY.index(alert["urgency"]), _SEVERITY.index(alert["severity"])


def _place(row: Row) -> tuple[Any, ...]:
    """In the order of `open_alerts`, then by aircraft."""
    return (
        row.get("place") or float("inf"),
        *(str(row.get(c) or "") for c in ("operator", "tail", "pack", "file", "since")),
    )


def _closed(was: Row, now: State) -> Row:
    """An alert that is open no more; one that is not on record any more was withdrawn."""
    row = now["closed"].get(was["alert_id"], was | {"closed_on": None, "outcome": "withdrawn"})
    return dict(row) | {"was": was}


def _moved(before: dict[str, Row], now: dict[str, Row]) -> Iterable[Row]:
    """Outlooks of the same unit that lie outside the 90 % interval that was told, the flights flown since counted."""
    for name, row in now.items():
        was = before.get(name)
        if was is None or was["life"] != row["life"]:
            continue
        flown = max(row["n_flights"] - was["n_flights"], 0)
        middle = min(row["rul_flights"] + flown, HORIZON)
        if middle < was["rul_low"] or (middle > was["rul_high"] and was["rul_high"] < HORIZON):
            yield row | {"was": was, "flown": flown}
