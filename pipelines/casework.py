"""List cases, and check and write what people do about them by one set of rules."""

from collections.abc import Callable, Mapping
from datetime import UTC, date, datetime, time, timedelta
from pathlib import Path
from typing import Any

import polars as pl

from hdt_core.alerts.diagnoses import LOSS
from hdt_core.alerts.succession import KINDS_OF_NIGHT, WITHDRAW
from hdt_core.components.declaration import FAULTS, NO_FAULT
from hdt_core.loading import UserError
from pipelines.storage.cases import CaseLog
from pipelines.storage.catalog import fetch_dicts
from pipelines.storage.catalog_checks import connect_current
from pipelines.storage.publication import publish_lines

_CODES = {"clean": NO_FAULT} | {code.lower(): code for code in FAULTS}
"""Findings of any part, as people enter them and as the maintenance log has them."""
_CODES_OF = {
    "HX": {},
    "CC": {"serviceable": NO_FAULT, "eroded": "DAMAGED"},
    "RAM_DOOR": {"moves freely": NO_FAULT, "jammed": "DAMAGED", "out of rig": "DAMAGED"},
    "SENSOR": {"reads correctly": NO_FAULT, "reads wrongly": "DAMAGED", "wiring fault": "DAMAGED"},
}
"""Further findings by component; their own words go into the note, as the log has no code for them."""
_CODES_OF_DECLARED = {"serviceable": NO_FAULT, "worn": "DAMAGED"}
ACTIONS = ("inspected", "cleaned", "replaced", "adjusted")
LONGEST_MUTE = timedelta(days=366)
KINDS = ("acknowledge", "assign", "mute", "watch", "unwatch", "close", "reopen")
Case = Mapping[str, Any]
_ALERT = ("alert_id", "operator", "tail", "pack", "component", "diagnosis")
_STATE_THEN = {
    "case_id": "case_id",
    "sensor": "sensor",
    "severity_then": "severity",
    "loss_then": "now_loss",
    "p_event_50_then": "now_p_event_50",
    "raised_then": "raised_at",
    "last_then": "open_until",
}
_OPEN_ONLY = ("acknowledge", "assign", "mute")
_MAX_TEXT, _MAX_NAME = 1000, 80


def findings(component: str) -> dict[str, str]:
    """Map what an inspection of a component may find to the maintenance log's codes."""
    return _CODES_OF.get(component, _CODES_OF_DECLARED) | _CODES


class RefusedError(UserError):
    """A change that can't be made; the message names the reason and the accepted values."""


def change_case(home: Path, case: Case, kind: str, person: str, last_line: int | None = None, **fields: Any) -> str:
    """Write one line about a case and return a sentence on its effect.

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
        Who makes the change.
    last_line : int, optional
        `last_line` of the case when this person read it; None writes in any case.
    fields : Any
        Values of the kind, as text, and `note`.

    Raises
    ------
    RefusedError
        A value is missing or wrong, or the change does not fit the case's state.
    ConflictError
        Somebody else changed the case since `last_line`.
    """
    if kind in _OPEN_ONLY and case["closed_at"] is not None:
        raise RefusedError(f"this alert closed on {case['closed_on']} ({case['closed_reason']})")
    body = {"note": _text(fields.get("note"), "note")} | (_BODY[kind](case, fields) if kind in _BODY else {})
    if kind == "close" and case["closed_at"] is not None:
        _require_own_work(home, case, body)
    state = {column: case[key] for column, key in _STATE_THEN.items()}
    line = {k: v for k, v in (body | state).items() if v is not None}
    alert = {c: case[c] for c in _ALERT} | {"operator": case["key_operator"], "tail": case["key_tail"]}
    CaseLog(home).append(alert, kind, _name(person, "by"), line, last_line)
    publish_lines(home)
    return f"{case['operator']} {case['tail']} pack {case['pack']}: {_effect(kind, body, case)}"


def _assign(case: Case, fields: Mapping[str, Any]) -> dict[str, Any]:
    return {"assignee": _name(fields.get("assignee"), "to")}


def _mute(case: Case, fields: Mapping[str, Any]) -> dict[str, Any]:
    _require_note(fields, "a mute")
    now = datetime.now(UTC)
    until = parse_moment(fields.get("until"), "until")[1]
    if not now < until < now + LONGEST_MUTE:
        raise RefusedError(f"until is a day within the next {LONGEST_MUTE.days} days, not {fields.get('until')}")
    return {"until": until.isoformat()}


def _close(case: Case, fields: Mapping[str, Any]) -> dict[str, Any]:
    finding, action = (str(fields.get(k) or "").lower() for k in ("finding", "action"))
    codes = findings(case["component"])
    if finding not in codes:
        raise RefusedError(f"finding is {', '.join(codes)}, not {finding or 'nothing'}")
    action = action or ACTIONS[0]
    if action not in ACTIONS:
        raise RefusedError(f"action is {', '.join(ACTIONS)}, not {action}")
    now = datetime.now(UTC)
    on = fields.get("on")
    day, at = parse_moment(on, "on") if on else (now.date(), now)
    if day < case["raised_at"].date() or day > now.date() or (_has_time(on) and at > now):
        raise RefusedError(f"on is a day from {case['raised_at'].date()}, when it was raised, to today, not {on}")
    note = _text(fields.get("note"), "note")
    return {
        "note": note if finding in _CODES else "; ".join(filter(None, (finding, note))),
        "finding": codes[finding],
        "action": action.upper(),
        "done_on": day.isoformat(),
        "done_at": at.isoformat() if _has_time(on) or not on else None,
        "reference": _text(fields.get("reference"), "reference"),
    }


def _require_own_work(home: Path, case: Case, body: Mapping[str, Any]) -> None:
    """Refuse work on a closed case that would count for an open one; a closing is corrected until the next alert."""
    day, at = parse_moment(body["done_at"] or body["done_on"], "on")
    is_later = case["finding"] is None and day > case["closed_at"].date()
    of_unit = {c: case[c] for c in ("operator", "tail", "pack", "component", "closed_at")}
    if others := list_cases(home, _WORKED_ON_TOO, at=at, is_later=is_later, **of_unit):
        raise RefusedError(
            f"this alert closed on {case['closed_on']} ({case['closed_reason']}); work of {day} counts for"
            f" {' and '.join(c['case_id'] for c in others)}, open now: close that, or give the day of this alert's (on)"
        )


def _reopen(case: Case, fields: Mapping[str, Any]) -> dict[str, Any]:
    if case["finding"] is None and case["muted_until"] is None:
        raise RefusedError("this case is neither closed by a finding nor muted: nothing to take back")
    _require_note(fields, "taking a closing or mute back")
    return {}


_BODY: dict[str, Callable[[Case, Mapping[str, Any]], dict[str, Any]]] = {
    "assign": _assign, "mute": _mute, "close": _close, "reopen": _reopen,
}  # fmt: skip


def _require_note(fields: Mapping[str, Any], change: str) -> None:
    if not _text(fields.get("note"), "note"):
        raise RefusedError(f"{change} needs a note with the reason")


def parse_moment(value: Any, name: str) -> tuple[date, datetime]:
    """Parse a day or a time in UTC: its day, and the moment it stands for; a day without a time stands for its end."""
    try:
        if not _has_time(value):
            day = date.fromisoformat(str(value))
            return day, datetime.combine(day, time(), UTC) + timedelta(days=1)
        at = datetime.fromisoformat(str(value))
        at = at.replace(tzinfo=UTC) if at.tzinfo is None else at.astimezone(UTC)
        return at.date(), at
    except (ValueError, OverflowError):  # the calendar's last day has no end, nor its first hour one before it
        raise RefusedError(f"{name} is a day (2024-06-19) or a time in UTC (2024-06-19T04:30), not {value}") from None


def _has_time(value: Any) -> bool:
    return ":" in str(value or "")


def _text(value: Any, name: str) -> str | None:
    """Printable text of one or a few lines; None where it is empty."""
    text = "".join(c for c in str(value or "") if c.isprintable() or c == "\n").strip()
    if len(text) > _MAX_TEXT:
        raise RefusedError(f"{name} has {len(text)} characters; the limit is {_MAX_TEXT}")
    return text or None


def _name(value: Any, name: str) -> str:
    text = _text(value, name)
    if text is None or len(text) > _MAX_NAME or "\n" in text:
        raise RefusedError(f"{name} is a person's name of up to {_MAX_NAME} characters")
    return text


_EFFECTS = {
    "acknowledge": "acknowledged.",
    "assign": "assigned to {assignee}.",
    "mute": "muted until {until:.16}Z, or until it gets worse.",
    "watch": "watched.",
    "unwatch": "no longer watched.",
    "reopen": "open again; the closing or mute is taken back.",
}


def _effect(kind: str, body: Mapping[str, Any], case: Case) -> str:
    if kind != "close":
        return _EFFECTS[kind].format_map(body)
    finding = body["finding"].lower().replace("_", " ")
    head = f"{finding}, {body['action'].lower()} on {body['done_on']}."
    if body["action"] != "INSPECTED":
        return f"{head} The alert is closed; the next night estimates the part anew from its first flight."
    if body["finding"] == NO_FAULT:
        after = " A further loss is raised as a sensor case." if case["diagnosis"] in LOSS else ""
        return f"{head} The alert is closed as found clean.{after}"
    return f"{head} It stays open, confirmed, until the part is cleaned or replaced."


OPEN = "state != 'closed'"
_WORKED_ON_TOO = f"""{OPEN} and c.operator = $operator and c.tail = $tail and c.pack is not distinct from $pack
    and c.component = $component and c.raised_at < $at and (c.raised_at > $closed_at or $is_later)"""
_CASES = """
    with known as (select alert_id, list(known_as) as names from alert_cases group by alert_id)
    select
        c.*, s.sensor, s.now_loss, s.now_p_event_50, s.evidence_now, s.evidence_now_phrases,
        s.recommended_action, s.action_phrases, s.follows, k.names,
        s.closed_on,
        coalesce(s.closed_at, s.now_departed_at) as open_until,
        coalesce(n.key_operator, c.operator) as key_operator, coalesce(n.key_tail, c.tail) as key_tail
    from cases as c
    join alert_states as s using (alert_id)
    join known as k using (alert_id)
    left join open_alerts as o using (alert_id)
    left join (select distinct present_operator, present_tail, key_operator, key_tail from tables.names) as n
        on c.operator = n.present_operator and c.tail = n.present_tail"""


def list_cases(home: Path, where: str = OPEN, **values: Any) -> list[dict[str, Any]]:
    """Return rows of the view `cases` as of now, the most urgent first.

    Parameters
    ----------
    home : Path
        Holds the catalog and the log of cases.
    where : str
        SQL condition over the view's columns and those of `alert_states`, written by us; `names` lists the ids by which
        a case is known.
    values : Any
        Values of its `$name` places.
    """
    publish_lines(home)
    with connect_current(home) as con:
        query = f"{_CASES} where {where} order by o.place nulls last, c.raised_at, c.alert_id"
        return fetch_dicts(con.execute(query, values))


NAMED = "c.alert_id in (select alert_id from alert_cases where known_as = $id)"
_NAMED_SO = "c.alert_id in (select alert_id from alert_cases where starts_with(known_as, $id))"


def find_case(home: Path, name: str) -> dict[str, Any]:
    """Return the case of this id, or the only one whose id, or whose alert's id of now or before, starts so.

    Raises
    ------
    UserError
        No id, or those of several cases, start so; or its alert was withdrawn.
    """
    cases = (list_cases(home, NAMED, id=name) or list_cases(home, _NAMED_SO, id=name)) if name else []
    withdrawn = [] if cases or not name else withdrawn_cases(home, lambda own: own.startswith(name))
    if len(withdrawn) == 1:
        raise UserError(f"alert {name}: {why_withdrawn(withdrawn[0])}")
    if len(cases) != 1:
        raise UserError(f"{'several alerts' if cases else 'no alert'} {name}; `hdt case list` names them")
    return cases[0]


def withdrawn_cases(home: Path, is_asked: Callable[[str], bool]) -> list[dict[str, Any]]:
    """Return cases whose alert a night found no longer raised, the last first.

    Parameters
    ----------
    home : Path
        Holds the log of cases.
    is_asked : callable
        Whether an id, of the case or of an alert that it had, is asked for.

    Returns
    -------
    list of dict
        The night's line in the log, a row of `raw_cases`, and `names`, the ids by which the case is known.
    """
    entries = CaseLog(home).entries()
    of_nights = entries.filter(pl.col("kind").is_in(KINDS_OF_NIGHT)).sort("line", descending=True)
    last_of_nights = of_nights.unique("case_id", keep="first", maintain_order=True)
    alerts_of_case = dict(entries.group_by("case_id").agg(pl.col("alert_id").unique().sort()).iter_rows())
    withdrawn = last_of_nights.filter(kind=WITHDRAW).to_dicts()
    cases = [row | {"names": [row["case_id"], *alerts_of_case[row["case_id"]]]} for row in withdrawn]
    return [case for case in cases if any(map(is_asked, case["names"]))]


def why_withdrawn(case: Case) -> str:
    """State when and why a night withdrew a case, a row of `withdrawn_cases`."""
    return (
        f"withdrawn by the night of {case['at']:%Y-%m-%d}: by the flights, limits and models of that night there is no"
        " such alert any more"
    )


def history_of(home: Path, case: Case) -> list[dict[str, Any]]:
    """Return a case's lines of the log by people, oldest first: rows of `raw_cases`."""
    own = pl.col("case_id").is_in(case["names"]) & ~pl.col("kind").is_in(KINDS_OF_NIGHT)
    return CaseLog(home).entries().filter(own).sort("line").to_dicts()
