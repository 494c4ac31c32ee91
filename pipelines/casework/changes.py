"""What may be done about a case, checked and written: the same for the command line and the page."""

from collections.abc import Callable, Mapping
from datetime import UTC, date, datetime, time, timedelta
from pathlib import Path
from typing import Any

from pipelines.storage.cases import CaseLog

FOUND = {
    "clean": "NO_FAULT_FOUND", "fouled": "FOULED", "clogged": "CLOGGED", "corroded": "CORRODED", "damaged": "DAMAGED",
}  # fmt: skip
"""Findings as an engineer says them, and as the maintenance log has them."""
DONE = ("inspected", "cleaned", "replaced", "adjusted")
LONGEST = timedelta(days=366)
_ALERT = ("alert_id", "operator", "tail", "pack", "component", "diagnosis")
_STOOD = {"severity": "severity", "loss": "now_loss", "p_event_50": "now_p_event_50"}
_TEXT, _NAME = 1000, 80


class RefusedError(ValueError):
    """What was asked can't be done; says why and what can."""


def change_case(
    home: Path, case: Mapping[str, Any], kind: str, person: str, seen: int | None = None, **asked: Any
) -> str:
    """Write one line about a case; what follows from it, in words.

    Parameters
    ----------
    home : Path
        Holds the log.
    case : mapping
        The case as it stands, a row of `list_cases`.
    kind : str
        acknowledge, assign (`assignee`), mute (`until`), watch, unwatch, close (`finding`, `action`, `on`, `reference`)
        or reopen.
    person : str
        Who does it.
    seen : int, optional
        `last_line` of the case as its writer saw it; None writes in any case.
    asked : Any
        What belongs to the kind, as text, and `note`.

    Raises
    ------
    RefusedError
        Something is missing, wrong, or makes no sense for this case.
    ConflictError
        Somebody else changed the case since.
    """
    body = {"note": _text(asked.get("note"), "note"), **_BODY[kind](case, asked)}
    stood = {f"{c}_then": case[k] for c, k in _STOOD.items()}
    alert = {c: case[c] for c in _ALERT}
    told = {k: v for k, v in (body | stood).items() if v is not None}
    CaseLog(home).append(alert, kind, _name(person, "by"), told, seen)
    return _SAYS[kind](case, body)


def _acknowledge(case: Mapping[str, Any], asked: Mapping[str, Any]) -> dict[str, Any]:
    _must_be_open(case)
    return {}


def _assign(case: Mapping[str, Any], asked: Mapping[str, Any]) -> dict[str, Any]:
    _must_be_open(case)
    return {"assignee": _name(asked.get("assignee"), "to")}


def _mute(case: Mapping[str, Any], asked: Mapping[str, Any]) -> dict[str, Any]:
    _must_be_open(case)
    if not _text(asked.get("note"), "note"):
        raise RefusedError("say why: a muted case wants a note")
    now, until = datetime.now(UTC), moment(asked.get("until"), "until")[1]
    if not now < until < now + LONGEST:
        raise RefusedError(f"until is a day within the next {LONGEST.days} days, not {asked.get('until')}")
    return {"until": until.isoformat()}


def _watch(case: Mapping[str, Any], asked: Mapping[str, Any]) -> dict[str, Any]:
    return {}


def _close(case: Mapping[str, Any], asked: Mapping[str, Any]) -> dict[str, Any]:
    finding, action = (str(asked.get(k) or "").lower() for k in ("finding", "action"))
    if finding not in FOUND:
        raise RefusedError(f"finding is {', '.join(FOUND)}, not {finding or 'nothing'}")
    action = action or DONE[0]
    if action not in DONE:
        raise RefusedError(f"action is {', '.join(DONE)}, not {action}")
    now = datetime.now(UTC)
    given = asked.get("on")
    day, at = moment(given, "on") if given else (now.date(), now)
    if day < case["raised_at"].date() or day > now.date() or (_timed(given) and at > now):
        raise RefusedError(f"on is a day from {case['raised_at'].date()}, when it was raised, to today, not {given}")
    return {
        "finding": FOUND[finding],
        "action": action.upper(),
        "done_on": day.isoformat(),
        "done_at": at.isoformat() if _timed(given) or not given else None,
        "reference": _text(asked.get("reference"), "reference"),
    }


def _reopen(case: Mapping[str, Any], asked: Mapping[str, Any]) -> dict[str, Any]:
    if case["finding"] is None and case["muted_until"] is None:
        raise RefusedError("nobody has closed or muted this case, so there is nothing to take back")
    if not _text(asked.get("note"), "note"):
        raise RefusedError("say why: what is taken back wants a note")
    return {}


_BODY = {
    "acknowledge": _acknowledge, "assign": _assign, "mute": _mute, "watch": _watch, "unwatch": _watch, "close": _close,
    "reopen": _reopen,
}  # fmt: skip
KINDS = tuple(_BODY)


def _must_be_open(case: Mapping[str, Any]) -> None:
    if case["closed_at"] is not None:
        raise RefusedError(f"this alert closed on {case['closed_at'].date()} ({case['closed_reason']})")


def moment(given: Any, name: str) -> tuple[date, datetime]:
    """A day or a time in UTC, as a day and the moment it stands for: of a day alone, its end."""
    try:
        if not _timed(given):
            day = date.fromisoformat(str(given))
            return day, datetime.combine(day, time(), UTC) + timedelta(days=1)
        at = datetime.fromisoformat(str(given))
        at = at.replace(tzinfo=UTC) if at.tzinfo is None else at.astimezone(UTC)
        return at.date(), at
    except (ValueError, OverflowError):  # the last day has no end, and the first hour none before it
        raise RefusedError(f"{name} is a day (2024-06-19) or a time in UTC (2024-06-19T04:30), not {given}") from None


def _timed(given: Any) -> bool:
    return ":" in str(given or "")


def _text(given: Any, name: str) -> str | None:
    """A text of one or a few lines; None where there is none."""
    text = "".join(c for c in str(given or "") if c.isprintable() or c == "\n").strip()
    if len(text) > _TEXT:
        raise RefusedError(f"{name} has {len(text)} characters; {_TEXT} are kept")
    return text or None


def _name(given: Any, name: str) -> str:
    text = _text(given, name)
    if text is None or len(text) > _NAME or "\n" in text:
        raise RefusedError(f"{name} is a person's name of up to {_NAME} characters")
    return text


def _named(case: Mapping[str, Any]) -> str:
    return f"{case['diagnosis']} of {case['tail']} pack {case['pack']}"


def _says_closed(case: Mapping[str, Any], body: Mapping[str, Any]) -> str:
    head = f"{_named(case)}: {body['finding']}, {body['action'].lower()} on {body['done_on']}."
    if body["action"] != "INSPECTED":
        return f"{head} The next night closes the alert and judges the renewed part from its first flight."
    if body["finding"] == "NO_FAULT_FOUND":
        return (
            f"{head} The next night closes the alert as found clean; should the loss grow on, it comes back as a case "
            "of the sensors."
        )
    return f"{head} It stays open, confirmed, until the part is cleaned or replaced; the next night counts it as a hit."


_SAYS: dict[str, Callable[[Mapping[str, Any], Mapping[str, Any]], str]] = {
    "acknowledge": lambda case, body: f"{_named(case)}: acknowledged.",
    "assign": lambda case, body: f"{_named(case)}: assigned to {body['assignee']}.",
    "mute": lambda case, body: f"{_named(case)}: muted until {body['until'][:16]}Z, or until it is worse.",
    "watch": lambda case, body: f"{_named(case)}: watched.",
    "unwatch": lambda case, body: f"{_named(case)}: not watched any more.",
    "close": _says_closed,
    "reopen": lambda case, body: f"{_named(case)}: what was closed or muted is taken back.",
}
