"""Render a digest as text, as a page and as JSON."""

import json
from datetime import date
from pathlib import Path
from typing import Any

from pipelines.digest.changes import Digest, Row
from pipelines.intake.faults import describe_silence
from pipelines.intake.held import describe_held
from pipelines.report import words
from pipelines.report.templating import templates_of
from pipelines.storage.files import replacing
from pipelines.words import several

MAX_ROWS = 20
"""Rows of a kind listed in text and page; JSON has all."""
TITLES = {
    "failed": "The night failed",
    "new": "New alerts",
    "worse": "Worse",
    "closed": "Closed",
    "moved": "Flights left outside their earlier interval",
    "eased": "Eased",
    "silent": "Columns that fell silent",
    "gap": "Data gaps",
    "held": "Flights that are held",
    "refused": "Files refused, whole or in part",
    "noted": "Files taken in with a note",
}
_GAPS = {
    "missing_leg": "{flights} after {after_flight_id} never arrived",
    "silence": "silent for {silent_days:.0f} days from {since}",
    "silent_now": "silent since {since}",
    "never_heard": "on the fleet list, no file yet",
    "unlogged_work": "{component} recovered on {since} as after a wash or replacement, and the log has none",
}
PAGES = templates_of("pipelines.digest", finalize=lambda value: "" if value is None else value)
"""Templates of this package. Their text is already escaped for hidden characters, and mail needs ordinary spaces."""


def subject(digest: Digest) -> str:
    """Return a line such as `Fleet: 1 new, 2 worse, 1 closed`."""
    counts = ", ".join(f"{len(rows)} {'gaps' if kind == 'gap' else kind}" for kind, rows in digest.changes.items())
    return f"Fleet: {counts or 'nothing changed'}"


def lines(digest: Digest) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return for each kind its title and for each row unit and text; rows beyond `MAX_ROWS` are counted."""
    groups = []
    for kind, rows in digest.changes.items():
        items = [(words.visible(_unit(row)), words.visible(_SENTENCE[kind](row))) for row in rows[:MAX_ROWS]]
        more = [("", f"and {len(rows) - MAX_ROWS} more")] if len(rows) > MAX_ROWS else []
        groups.append((TITLES[kind], items + more))
    return groups


def span(digest: Digest) -> str:
    """Return the line with the flights that the digest covers, or with the moment of a failure."""
    if "failed" in digest.changes:
        return f"At {digest.until} UTC. What is done stays; the next night tries the rest again."
    if digest.until is None:
        return "No flight yet."
    since = f" The digest before covers those up to {digest.since} UTC." if digest.since else ""
    return f"Flights up to {digest.until} UTC.{since}"


def as_text(digest: Digest) -> str:
    """Render as plain text."""
    return _render("digest.txt", digest)


def as_html(digest: Digest) -> str:
    """Render as a page that needs no network."""
    return _render("digest.html", digest)


def as_json(digest: Digest) -> str:
    """Render every row as JSON, for a program."""
    return json.dumps({"since": digest.since, "until": digest.until, "changes": digest.changes}, indent=1)


def write_digest(digest: Digest, folder: Path, stem: str) -> None:
    """Write `<stem>.txt`, `<stem>.html` and `<stem>.json` into a folder."""
    for ending, form in {"txt": as_text, "html": as_html, "json": as_json}.items():
        with replacing(folder / f"{stem}.{ending}") as file:
            file.write_text(form(digest), encoding="utf-8")


def as_webhook(digest: Digest) -> dict[str, Any]:
    """Return the JSON of `as_json` with the plain text in `text`, which chat systems post as it stands."""
    return dict(json.loads(as_json(digest)), text=as_text(digest))


def _render(template: str, digest: Digest) -> str:
    return PAGES.get_template(template).render(title=subject(digest), span=span(digest), groups=lines(digest))


def _unit(row: Row) -> str:
    """Name the unit, such as `AQX LX-AAC pack 2 (right)`, or the file."""
    if "tail" not in row:
        return str(row["file"])
    unit = words.unit_name(row) if row.get("pack") else row["tail"]
    return f"{row['operator']} {unit}"


def _alert(row: Row) -> str:
    to_do = f"{words.urgency(row)}: {row['work']}."
    if "case_id" not in row:
        return f"{to_do} No alert is open."
    came_at = date.fromisoformat(row["came_at"]) if row.get("came_at") else None
    is_known = came_at or row["rul_flights"] is not None
    outlook = f" Flights left {words.flights_left(row | {'came_at': came_at})}." if is_known else ""
    head = f"{words.diagnosis(row['diagnosis'])} since {row['since']}, {row['severity']}."
    return f"{head} {to_do}{outlook} [{row['case_id']}]"


def _alert_change(row: Row) -> str:
    was = row["was"]
    steps = [f"{was[k]} to {row[k]}" for k in ("severity", "urgency") if was[k] != row[k]]
    return f"{', '.join(steps)}. {_alert(row)}"


_OUTCOMES = {
    "found": "a fault was found",
    "answered": "work took a loss away",
    "message": "the message came",
    "no_fault_found": "no fault was found",
    "recovered": "it recovered by itself",
    "open": "it is open",
    "not_yet_known": "not known yet what it was",
    "withdrawn": "the data show it no more",
}
"""What came of an alert, by its code in `alert_outcomes`."""


def _closing(row: Row) -> str:
    when = f" on {row['closed_on']}" if row["closed_on"] else ""
    work = f", {row['work_orders']}" if row.get("work_orders") else ""
    head = f"{words.diagnosis(row['diagnosis'])} since {row['since']}: closed{when}"
    return f"{head}: {_OUTCOMES[row['outcome']]}{work}. [{row['case_id']}]"


def _outlook(row: Row) -> str:
    part = words.PARTS.get(row["component"], row["component"])
    flights = several("{n} flight", "{n} flights", row["flown"])
    return f"{part}: flights left {words.flights_left(row)}; {flights} ago {words.flights_left(row['was'])}."


def _gap(row: Row) -> str:
    return _GAPS[row["gap"]].format(**row, flights=several("{n} flight", "{n} flights", row["n_flights"] or 0)) + "."


def _note(row: Row) -> str:
    return f"{row['reasons']}."


def _file_refusal(row: Row) -> str:
    rows = several("{n} row", "{n} rows", row["n_rows"] or 0)
    return f"{row['reasons']}; {rows}."


_SENTENCE = {"new": _alert, "worse": _alert_change, "closed": _closing, "moved": _outlook, "eased": _alert_change,
             "silent": describe_silence, "gap": _gap, "held": describe_held, "refused": _file_refusal,
             "noted": _note, "failed": _note}  # fmt: skip
