"""Summary page for release: figures with intervals and n, definitions, costs and exclusions; no raw row."""

from collections.abc import Iterable, Sequence
from typing import Any

from hdt_trial.evaluation import LATE_SEAL_DAYS, Evaluation
from hdt_trial.figures import Figure
from hdt_trial.seal import OURS
from pipelines.report.templating import policy, render

Part = dict[str, Any] | str
"""Content of a section; text is a paragraph. `document.html` renders each kind."""


def document(title: str, *parts: Part) -> str:
    """Render the document as HTML."""
    return render("document.html", title=title, parts=parts, policy=policy())


def section(title: str, *parts: Part | None) -> Part:
    """Return a section under a heading."""
    return {"kind": "section", "title": title, "parts": [p for p in parts if p is not None]}


def heading(title: str) -> Part:
    """Return a subheading."""
    return {"kind": "heading", "text": title}


def table(columns: Sequence[str], rows: Iterable[Sequence[Any]], empty: str = "None.") -> Part:
    """Return a table, or a sentence where it has no row."""
    body = list(rows)
    return {"kind": "table", "columns": columns, "rows": body} if body else empty


def bullets(items: Iterable[Any]) -> Part:
    """Return a list."""
    return {"kind": "bullets", "items": list(items)}


def verbatim(text: str) -> Part:
    """Return preformatted text."""
    return {"kind": "verbatim", "text": text}


def code(text: str) -> Part:
    """Return code within a cell."""
    return {"kind": "code", "text": text}


_VERDICTS = {
    "hit": "event in time",
    "too_late": "alert too late to act",
    "too_early": "alert too early",
    "answered": "work took away a loss before an event",
    "false_alarm": "false alarm",
    "after_event": "raised after the event: not scored",
    "removed": "unit removed without a finding: not scored",
    "open": "too few flights since: not scored yet",
}


def page(e: Evaluation) -> str:
    """Render the page as HTML."""
    share = f"{e.declared.confidence:.0%} intervals"
    return document(
        f"{e.declared.name}: {e.began} to {e.ended}",
        f"{e.flights:,} flights of {e.aircraft} aircraft, {e.nights} nights sealed. Version {e.version}.",
        section("Results", _figures(e, OURS), f"{share}; flights of one aircraft are treated as dependent."),
        *(section(f"The operator's rule {name}", _figures(e, name), _agreement(e, name)) for name in e.agreement),
        section("Alert outcomes", table(("", *e.verdicts), _verdict_rows(e)), *_exclusions(e)),
        section("Changes during the trial", bullets(e.changes) if e.changes else "Nothing.", _models(e)),
        section("Declaration, sealed before the first night", verbatim(e.text)),
        section("Verification", *_proof(e)),
        section("Suppressed figures", _suppression(e)),
    )  # fmt: skip


def _figures(e: Evaluation, source: str) -> Part:
    return table(("", "value", "interval", "n"), map(_row, e.figures[source]))


def _row(f: Figure) -> tuple[str, str, str, str]:
    if f.interval is None:
        return f.label, "suppressed", f.why_not, ""
    low, high = (_format_value(f, v) if v is not None else "open" for v in (f.interval.low, f.interval.high))
    n = f"{f.n:,} {f.of}" if f.n is not None else ""
    return f.label, f"{_format_value(f, f.interval.value)} {f.unit}", f"{low} to {high}", n


def _format_value(f: Figure, value: float) -> str:
    if f.unit == "%":
        return f"{100.0 * value:.1f}"
    return f"{value:,.2f}" if f.name == "false_alarms" else f"{value:,.0f}"


def _verdict_rows(e: Evaluation) -> list[tuple[str, ...]]:
    return [(label, *(_count(counts[name]) for counts in e.verdicts.values())) for name, label in _VERDICTS.items()]


def _count(n: int | None) -> str:
    return "suppressed" if n is None else f"{n:,}"


def _agreement(e: Evaluation, rule: str) -> Part:
    rows = [(who, _count(n)) for who, n in e.agreement[rule].items()]
    return table(("events foretold in time by", "events"), rows)


def _exclusions(e: Evaluation) -> list[str]:
    """State what is scored and what is left out."""
    lines = [f"Alerts and prognoses of these components are scored: {', '.join(e.declared.components)}."]
    if e.without_pack:
        lines.append("Messages and work orders that name no pack are left out.")
    return lines


def _models(e: Evaluation) -> str:
    return (
        f"{e.models} versions of the prognostic model were in service: each is trained on the fleet's completed lives."
    )


def _proof(e: Evaluation) -> list[str]:
    lines = [
        f"Digest of the log's last entry: {e.head}.",
        "Each night's alerts and prognoses were written to a chain of digests before outcomes were known. The log "
        "can be verified with `hdt trial verify` or with sha256sum.",
    ]
    if e.late_nights:
        lines.append(
            f"{e.late_nights} entries were sealed more than {LATE_SEAL_DAYS:.0f} days after their last flight."
        )
    if e.after_the_fact != 0:
        lines.append("A rehearsal on past flights: outcomes predate the seal, so it proves nothing.")
    return lines


def _suppression(e: Evaluation) -> str:
    m = e.declared.minimum
    return (
        f"Counts from 1 to {m.count - 1}, and figures that rest on fewer than {m.flights:,} flights or {m.aircraft} "
        f"aircraft, are suppressed; where a single count is suppressed, so is the smallest of the others. This page "
        f"contains no aircraft, no event date and no row of data."
    )
