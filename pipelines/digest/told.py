"""Who was told of what: each receiver of what changed since it was last told, once, and again if that failed.

`notify/sent.json` of the home says up to which night each receiver knows; the states that it refers to lie beside it.
It is written after each receiver, so a night that is killed and repeated tells nobody twice but the one that was being
told at that moment; an e-mail of the same digest then bears the same Message-ID.
"""

import json
from pathlib import Path
from typing import Any

from pipelines.digest.changes import compare
from pipelines.digest.declaration import NotifyError, Receiver, read_receivers
from pipelines.digest.render import as_json
from pipelines.digest.senders import send
from pipelines.digest.state import EMPTY, State, read_state
from pipelines.storage.catalog import connect
from pipelines.storage.files import replacing
from pipelines.storage.ledger import Ledger
from pipelines.storage.settings import notify_file
from pipelines.versions import digest as hashed

_FOLDER, _SENT = "notify", "sent.json"


def receivers_of(home: Path) -> list[Receiver]:
    """Receivers that a home declares; none where it has no `notify.toml`.

    Raises
    ------
    NotifyError
        The declaration is wrong; the line names the file.
    """
    file = notify_file(home)
    if not file.exists():
        return []
    try:
        return read_receivers(file.read_text(encoding="utf-8"))
    except (NotifyError, OSError, UnicodeDecodeError) as error:
        raise NotifyError(f"{file}: {error}") from None


def tell_night(home: Path) -> list[str]:
    """Tell each receiver what changed since it was last told; a line for each that could not be.

    Where nothing changed nothing is sent. A receiver that failed is told tonight's changes with the next night's.
    """
    try:
        receivers = receivers_of(home)
        night = max(Ledger(home, looks=True).snapshots(), default="") if receivers else ""
        sent = _sent(home)
        waiting = [r for r in receivers if sent.get(r.name, {}).get("night") != night]
        if not waiting or not night:
            return []
        with connect(home) as con:
            now = read_state(con)
    except Exception as error:  # the night is done and published, whatever keeps it from being told
        return [f"nobody was told: {error}"]
    failed = [line for r in waiting if (line := _tell(home, r, now, night, sent))]
    _sweep(home, sent)
    return failed


def try_out(home: Path) -> list[tuple[str, str]]:
    """Send every receiver what stands now, as if it were new, and record nothing: its name, and what went wrong."""
    with connect(home) as con:
        now = read_state(con)
    told = []
    for receiver in receivers_of(home):
        digest = compare(EMPTY, now).of(receiver.operator)
        try:
            send(receiver, digest, hashed("trial", receiver.name, as_json(digest)), home)
        except NotifyError as error:
            told.append((receiver.name, str(error)))
        else:
            told.append((receiver.name, ""))
    return told


def _tell(home: Path, receiver: Receiver, now: State, night: str, sent: dict[str, Any]) -> str:
    """What went wrong with one receiver; empty where nothing did."""
    entry = sent.get(receiver.name, {})
    digest = compare(_state(home, entry.get("told")), now).of(receiver.operator)
    if not digest.empty:
        try:
            send(receiver, digest, hashed(receiver.name, as_json(digest)), home)
        except Exception as error:  # no receiver may end a night, whatever its library raises
            return f"{receiver.name} was not told, and will be with the next night: {error}"
        entry = {"told": _keep(home, now)}
    sent[receiver.name] = entry | {"night": night}
    _write(home / _FOLDER / _SENT, sent)
    return ""


def _sent(home: Path) -> dict[str, Any]:
    """Of each receiver the last `night` it was considered, and the state it was `told`; empty where that is lost."""
    try:
        return dict(json.loads((home / _FOLDER / _SENT).read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return {}


def _state(home: Path, name: str | None) -> State:
    if name is None:
        return EMPTY
    try:
        return EMPTY | dict(json.loads((home / _FOLDER / name).read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return EMPTY


def _keep(home: Path, now: State) -> str:
    """Name under which a state is kept; alerts that are closed already need not be remembered."""
    kept = now | {"closed": {}}
    name = f"state-{hashed(json.dumps(kept))}.json"
    if not (home / _FOLDER / name).exists():
        _write(home / _FOLDER / name, kept)
    return name


def _write(path: Path, content: dict[str, Any]) -> None:
    with replacing(path) as file:
        file.write_text(json.dumps(content, indent=1), encoding="utf-8")


def _sweep(home: Path, sent: dict[str, Any]) -> None:
    """Remove states that no receiver's record refers to."""
    needed = {entry.get("told") for entry in sent.values()}
    for file in (home / _FOLDER).glob("state-*.json"):
        if file.name not in needed:
            file.unlink(missing_ok=True)
