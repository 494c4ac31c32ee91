"""Compare two nights: alerts, prognoses outside their earlier interval, gaps, silent columns, refused files."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hdt_core.prognosis.model import HORIZON
from pipelines.digest.state import EMPTY, State, read_state
from pipelines.report.tasks import read_tasks
from pipelines.storage.catalog import connect
from pipelines.storage.ledger import Ledger
from pipelines.storage.publication import connect_as_of

Row = dict[str, Any]
_URGENCY, _SEVERITY = ("none", "plan", "act"), ("low", "medium", "high")
KINDS = ("new", "worse", "closed", "moved", "eased", "silent", "gap", "refused")
"""Kinds of change, in the order of the digest."""


@dataclass(frozen=True, slots=True)
class Digest:
    """Changes between two nights.

    Attributes
    ----------
    since, until : str or None
        Last departure on record then and now (UTC); None where there was none.
    changes : dict of str to list of dict
        By kind, see `KINDS`; a kind without a change is absent. A row has `operator` and `tail` (both may be null for a
        file) and the columns of its kind; `was` is the row of the earlier state.
    """

    since: str | None
    until: str | None
    changes: dict[str, list[Row]]

    def of(self, operator: str | None) -> "Digest":
        """Return the changes of one operator; all with None."""
        if operator is None:
            return self
        own = {k: [r for r in rows if r["operator"] == operator] for k, rows in self.changes.items()}
        return replace(self, changes={k: rows for k, rows in own.items() if rows})


def changes_since(home: Path, night: str | None = None) -> Digest:
    """Return the changes since the last night at or before `night`; since the last but one without it.

    Raises
    ------
    StoreError
        There was no night by then, or it is no longer stored.
    """
    with connect(home) as con:
        now = read_state(con, read_tasks(home))
    nights = sorted(Ledger(home, read_only=True).snapshots())
    if night is None and len(nights) < 2:
        return compare(EMPTY, now)
    with connect_as_of(home, night or nights[-2]) as con:
        return compare(read_state(con), now)


def compare(before: State, now: State) -> Digest:
    """Return the changes between two states; an alert raised and closed in between does not appear."""
    pairs = [(before["alerts"][name], row) for name, row in now["alerts"].items() if name in before["alerts"]]
    changes = {
        "new": [row for name, row in now["alerts"].items() if name not in before["alerts"]],
        "worse": [row | {"was": was} for was, row in pairs if _weight(row) > _weight(was)],
        "closed": [_closing(was, now) for name, was in before["alerts"].items() if name not in now["alerts"]],
        "moved": list(_moved_outlooks(before["outlook"], now["outlook"])),
        "eased": [row | {"was": was} for was, row in pairs if _weight(row) < _weight(was)],
        "silent": [row for name, row in now["silent"].items() if name not in before["silent"]],
        "gap": [row for name, row in now["gaps"].items() if name not in before["gaps"]],
        "refused": [row for name, row in now["files"].items() if before["files"].get(name) != row],
    }
    in_order = {kind: sorted(rows, key=_order) for kind in KINDS if (rows := changes[kind])}
    return Digest(before["until"], now["until"], in_order)


def _weight(alert: Row) -> tuple[int, int]:
    return _URGENCY.index(alert["urgency"]), _SEVERITY.index(alert["severity"])


def _order(row: Row) -> tuple[Any, ...]:
    """Sort in the order of `open_alerts`, then by aircraft."""
    return (
        row.get("place") or float("inf"),
        *(str(row.get(c) or "") for c in ("operator", "tail", "pack", "file", "since")),
    )


def _closing(was: Row, now: State) -> Row:
    """Return a closed alert's row; an alert that is no longer stored was withdrawn."""
    row = now["closed"].get(was["alert_id"], was | {"closed_on": None, "outcome": "withdrawn"})
    return dict(row) | {"was": was}


def _moved_outlooks(before: dict[str, Row], now: dict[str, Row]) -> Iterable[Row]:
    """Yield units whose prognosis, plus the flights since, lies outside the earlier 90 % interval."""
    for name, row in now.items():
        was = before.get(name)
        if was is None or was["life"] != row["life"]:
            continue
        n_flown = max(row["n_flights"] - was["n_flights"], 0)
        middle = min(row["rul_flights"] + n_flown, HORIZON)
        if middle < was["rul_low"] or (middle > was["rul_high"] and was["rul_high"] < HORIZON):
            yield row | {"was": was, "flown": n_flown}
