"""A digest as text, as a page, as JSON, and as the messages that Slack and Teams take."""

import json
from pathlib import Path
from typing import Any

from pipelines.digest.changes import Digest, Row
from pipelines.intake.refusals import silence
from pipelines.report import words
from pipelines.report.templating import templates_of
from pipelines.storage.files import replacing
from pipelines.words import several

MOST = 20
"""Rows of a kind that are told by name; JSON has all."""
TITLES = {
    "new": "New alerts",
    "worse": "Worse",
    "closed": "Closed",
    "moved": "Flights left moved beyond their own interval",
    "eased": "Eased",
    "silent": "Columns that fell silent",
    "gap": "Data gaps",
    "refused": "Files refused, whole or in part",
}
_SHORT = {"new": "new", "worse": "worse", "closed": "closed", "moved": "moved", "eased": "eased", "silent": "silent",
          "gap": "gaps", "refused": "refused"}  # fmt: skip
_GAPS = {
    "missing_leg": "{flights} after {after_flight_id} never arrived",
    "silence": "silent for {silent_days:.0f} days from {since}",
    "silent_now": "silent since {since}",
    "never_heard": "on the fleet list, never heard of",
}
PAGES = templates_of("pipelines.digest", finalize=lambda value: "" if value is None else value)
"""This room's templates; rows are made visible before, and mail takes no other spaces than the usual one."""


def subject(digest: Digest) -> str:
    """`Fleet: 1 new, 2 worse, 1 closed`."""
    said = ", ".join(f"{len(rows)} {_SHORT[kind]}" for kind, rows in digest.changes.items())
    return f"Fleet: {said or 'nothing changed'}"


def lines(digest: Digest) -> list[tuple[str, list[tuple[str, str]]]]:
    """Of each kind its title, and of each row who and what; rows beyond `MOST` are counted."""
    told = []
    for kind, rows in digest.changes.items():
        said = [(words.visible(_who(row)), words.visible(_SAID[kind](row))) for row in rows[:MOST]]
        more = [("", f"and {len(rows) - MOST} more")] if len(rows) > MOST else []
        told.append((TITLES[kind], said + more))
    return told


def span(digest: Digest) -> str:
    """Between which flights the changes lie."""
    if digest.until is None:
        return "No flight has arrived yet."
    since = f" Last told of those up to {digest.since} UTC." if digest.since else ""
    return f"Flights up to {digest.until} UTC.{since}"


def as_text(digest: Digest) -> str:
    """Plain text."""
    return _filled("digest.txt", digest)


def as_html(digest: Digest) -> str:
    """A page that needs no network."""
    return _filled("digest.html", digest)


def as_json(digest: Digest) -> str:
    """Everything, for a program."""
    return json.dumps({"since": digest.since, "until": digest.until, "changes": digest.changes}, indent=1)


def write_digest(digest: Digest, folder: Path, stem: str) -> None:
    """`<stem>.txt`, `<stem>.html` and `<stem>.json` in a folder."""
    for ending, form in {"txt": as_text, "html": as_html, "json": as_json}.items():
        with replacing(folder / f"{stem}.{ending}") as file:
            file.write_text(form(digest), encoding="utf-8")


def as_slack(digest: Digest) -> dict[str, Any]:
    """For an incoming webhook of Slack: `text` is what a notification shows, blocks what the channel does."""
    blocks = [_section(f"*{_escaped(subject(digest))}*\n{_escaped(span(digest))}")]
    for title, rows in lines(digest):
        said = "\n".join(f"• *{_escaped(who)}* {_escaped(what)}" if who else _escaped(what) for who, what in rows)
        blocks.append(_section(f"*{title}*\n{said}"[:3000]))
    return {"text": subject(digest), "blocks": blocks}


def as_teams(digest: Digest) -> dict[str, Any]:
    """For a Workflows webhook of Teams: a message with one adaptive card."""
    body = [_block(subject(digest), weight="Bolder", size="Medium"), _block(span(digest), isSubtle=True)]
    for title, rows in lines(digest):
        body.append(_block(title, weight="Bolder", spacing="Medium"))
        body += [_block(f"- {who} {what}" if who else what) for who, what in rows]
    card = {"$schema": "http://adaptivecards.io/schemas/adaptive-card.json", "type": "AdaptiveCard", "version": "1.4"}
    content = {"contentType": "application/vnd.microsoft.card.adaptive", "content": card | {"body": body}}
    return {"type": "message", "attachments": [content]}


def _filled(template: str, digest: Digest) -> str:
    return PAGES.get_template(template).render(title=subject(digest), span=span(digest), groups=lines(digest))


def _section(text: str) -> dict[str, Any]:
    return {"type": "section", "text": {"type": "mrkdwn", "text": text}}


def _block(text: str, **look: Any) -> dict[str, Any]:
    return {"type": "TextBlock", "text": text, "wrap": True} | look


def _escaped(text: str) -> str:
    """Slack's three signs."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def _who(row: Row) -> str:
    """`AQX LX-AAC pack 2 (right)`; a file's name."""
    if "tail" not in row:
        return str(row["file"])
    unit = words.pack_name(row) if "pack" in row else row["tail"]
    return f"{row['operator']} {unit}"


def _alert(row: Row) -> str:
    outlook = f" Flights left {words.flights_left(row)}." if row["rul_flights"] is not None else ""
    said = f"{words.diagnosis(row['diagnosis'])} since {row['since']}, {row['severity']}. {words.urgency(row)}"
    return f"{said}: {words.plain(row['action']).rstrip('.')}.{outlook} [{row['alert_id']}]"


def _changed(row: Row) -> str:
    was = row["was"]
    said = [f"{was[k]} to {row[k]}" for k in ("severity", "urgency") if was[k] != row[k]]
    return f"{', '.join(said)}. {_alert(row)}"


def _ended(row: Row) -> str:
    when = f" on {row['closed_on']}" if row["closed_on"] else ""
    work = f", {row['work_orders']}" if row.get("work_orders") else ""
    said = f"{words.diagnosis(row['diagnosis'])} since {row['since']}: closed{when}"
    return f"{said}, outcome {row['outcome'].replace('_', ' ')}{work}. [{row['alert_id']}]"


def _outlook(row: Row) -> str:
    part = words.PARTS.get(row["component"], row["component"])
    flown = several("{n} flight", "{n} flights", row["flown"])
    return f"{part}: flights left {words.flights_left(row)}; {flown} ago {words.flights_left(row['was'])}."


def _gap(row: Row) -> str:
    return _GAPS[row["gap"]].format(**row, flights=several("{n} flight", "{n} flights", row["n_flights"] or 0)) + "."


def _refused(row: Row) -> str:
    return f"{row['reasons']}; {several('{n} row', '{n} rows', row['n_rows'] or 0)}."


_SAID = {"new": _alert, "worse": _changed, "closed": _ended, "moved": _outlook, "eased": _changed,
         "silent": silence, "gap": _gap, "refused": _refused}  # fmt: skip
