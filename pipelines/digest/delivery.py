"""Send each receiver the changes since its last digest; retry failures the next night.

`notify/sent.json` in the home records for each receiver the night of its last digest and the state it described. It is
written after each receiver, so a night that is killed and repeated sends again only the digest in progress at that
moment; a repeated e-mail bears the same Message-ID.
"""

import json
from pathlib import Path
from typing import Any

from pipelines.digest.changes import compare
from pipelines.digest.declaration import NotifyError, Receiver, receivers_of
from pipelines.digest.render import as_json
from pipelines.digest.senders import send
from pipelines.digest.state import EMPTY, State, read_state
from pipelines.report.tasks import read_tasks
from pipelines.storage.catalog import connect
from pipelines.storage.files import replacing
from pipelines.storage.ledger import Ledger
from pipelines.versions import digest as hash_text

_FOLDER, _RECORD = "notify", "sent.json"


def send_digests(home: Path) -> list[str]:
    """Send each receiver what changed since its last digest; return a line for each failure.

    Without a change nothing is sent. A receiver that failed gets tonight's changes with the next night's.
    """
    try:
        receivers = receivers_of(home)
        night = max(Ledger(home, read_only=True).snapshots(), default="") if receivers else ""
        record: dict[str, Any] = _read_json(home / _FOLDER / _RECORD)
        waiting = [r for r in receivers if record.get(r.name, {}).get("night") != night]
        if not waiting or not night:
            return []
        with connect(home) as con:
            now = read_state(con, read_tasks(home))
    except Exception as error:  # the night is published whether or not its digest can be sent
        return [f"no digest was sent: {error}"]
    failures = [line for r in waiting if (line := _deliver(home, r, now, night, record))]
    _remove_unused_states(home, record)
    return failures


def send_trial(home: Path) -> list[tuple[str, str]]:
    """Send every receiver the present state as if it were new, record nothing; return each name and its error."""
    with connect(home) as con:
        now = read_state(con, read_tasks(home))
    results = []
    for receiver in receivers_of(home):
        digest = compare(EMPTY, now).of(receiver.operator)
        try:
            send(receiver, digest, hash_text("trial", receiver.name, as_json(digest)), home)
        except NotifyError as error:
            results.append((receiver.name, str(error)))
        else:
            results.append((receiver.name, ""))
    return results


def _deliver(home: Path, receiver: Receiver, now: State, night: str, record: dict[str, Any]) -> str:
    """Send to one receiver and record it; return the error, empty where there is none."""
    entry = record.get(receiver.name, {})
    before = EMPTY | _read_json(home / _FOLDER / entry["told"]) if "told" in entry else EMPTY
    digest = compare(before, now).of(receiver.operator)
    if digest.changes:
        try:
            send(receiver, digest, hash_text(receiver.name, as_json(digest)), home)
        except Exception as error:  # no receiver may end a night, whatever its library raises
            return f"{receiver.name} got no digest; the next night tries again: {error}"
        entry = {"told": _write_state(home, now)}
    record[receiver.name] = entry | {"night": night}
    _write_json(home / _FOLDER / _RECORD, record)
    return ""


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return {}


def _write_json(path: Path, content: dict[str, Any]) -> None:
    with replacing(path) as file:
        file.write_text(json.dumps(content, indent=1), encoding="utf-8")


def _write_state(home: Path, now: State) -> str:
    """Write a state, without its closed alerts, and return its file name."""
    state = now | {"closed": {}}
    name = f"state-{hash_text(json.dumps(state))}.json"
    if not (home / _FOLDER / name).exists():
        _write_json(home / _FOLDER / name, state)
    return name


def _remove_unused_states(home: Path, record: dict[str, Any]) -> None:
    state_names = {entry.get("told") for entry in record.values()}
    for file in (home / _FOLDER).glob("state-*.json"):
        if file.name not in state_names:
            file.unlink(missing_ok=True)
