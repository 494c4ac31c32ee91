"""Who needs attention, in order, and why."""

import re
from datetime import timedelta
from typing import Any

import polars as pl

from hdt_core.health.evidence import ROLES
from pipelines.report import words
from pipelines.report.facts import Facts
from pipelines.report.html import Html, anchor, join, tag
from pipelines.report.tables import Cell, plain, table

CLOSED_DAYS = 180  # alerts closed longer ago are history: the catalog has them
_RANKING = (
    "Place",
    "Operator",
    "Pack",
    "Urgency",
    "UA lost",
    "Flights left (90 %)",
    "Message in 50 flights",
    "Compressor loss",
    "Open alerts",
    "Last flight",
)


def ranking(facts: Facts) -> Html:
    """Every pack, the most urgent first."""
    rows = facts["ranking"].to_dicts()
    if not rows:
        return tag("p", "No pack has a health estimate yet.", class_="empty")
    says = (
        "UA lost: the share of the heat exchanger's conductance that is gone, ± one standard deviation. "
        "Flights left: until the aircraft raises its message, with a 90 % interval."
    )
    shown = table(_RANKING, map(_ranked, rows), sortable=True, finds=[words.found_by(r, r["diagnoses"]) for r in rows])
    return join(tag("p", says, class_="small"), shown)


def _ranked(r: dict[str, Any]) -> list[Cell]:
    link = tag("a", words.pack_name(r), href=f"#{anchor('pack', r['operator'], r['tail'], r['pack'])}")
    urgency = tag("span", words.URGENCY[r["urgency"]], class_=f"tag {r['urgency']}")
    diagnoses = words.diagnosis(r["diagnoses"]) if r["diagnoses"] else ""
    last = words.day(r["last_departed_at"])
    return [
        (r["place"], r["place"]),
        (r["operator"], r["operator"]),
        (link, f"{r['tail']} {r['pack']}"),
        (urgency, list(words.URGENCY).index(r["urgency"])),
        (words.loss(r), r["hx_fouling"]),
        (words.flights_left(r), r["rul_flights"]),
        (words.chance(r["p_event_50"]), r["p_event_50"]),
        (words.percent(r["cc_efficiency_loss"], 1), r["cc_efficiency_loss"]),
        (diagnoses, diagnoses or None),
        (last, last),
    ]


def alerts(facts: Facts) -> Html:
    """Open alerts in full, in the ranking's order; those closed lately in a line each, folded away."""
    rows = facts["alerts"]
    if not rows.height:
        return tag("p", "No alert has been raised.", class_="empty")
    opened = rows.filter(pl.col("closed_at").is_null()).to_dicts()
    cards = [_alert(a) for a in opened] or [tag("p", "No alert is open.", class_="empty")]
    return join(*cards, _closed(facts, rows.filter(pl.col("closed_at").is_not_null())))


def _closed(facts: Facts, rows: pl.DataFrame) -> Html | None:
    if not rows.height:
        return None
    until = facts.until()
    late = rows.filter(pl.col("closed_at") >= until - timedelta(days=CLOSED_DAYS)) if until else rows
    body = [
        plain(
            words.day(a["raised_at"]),
            words.day(a["closed_at"]),
            words.pack_name(a),
            words.diagnosis(a["diagnosis"]),
            a["raised_severity"],
            words.tidy(a["evidence"]),
        )
        for a in late.to_dicts()
    ]
    older = rows.height - late.height
    return tag(
        "details",
        tag("summary", f"{words.count(late.height, 'alert')} closed in the last {CLOSED_DAYS} days"),
        table(
            ("Raised", "Closed", "Pack", "What", "Severity when raised", "Evidence when raised"),
            body,
            finds=[words.found_by(a, a["diagnosis"]) for a in late.to_dicts()],
        ),
        tag("p", f"{words.count(older, 'older alert')} in the catalog, view alerts.", class_="small")
        if older
        else None,
    )


def _alert(a: dict[str, Any]) -> Html:
    urgency = tag("span", words.URGENCY[a["urgency"]], class_=f"tag {a['urgency']}")
    return tag(
        "article",
        tag("h3", words.pack_name(a), ": ", words.diagnosis(a["diagnosis"]), " ", urgency),
        tag("p", tag("b", "To do: "), words.tidy(a["recommended_action"])),
        _then_and_now(a),
        *_reasons(a),
        tag("p", f"{a['operator']}, case {a['alert_id']}.", class_="small"),
        class_="card alert",
        data_find=words.found_by(a, a["diagnosis"]),
    )


def _then_and_now(a: dict[str, Any]) -> Html:
    """The same numbers when raised and now, one above the other."""
    moments = (("When raised", "raised"), ("Now", "now"))
    names = [name for name, _ in words.alert_state(a, "now")]
    rows = [
        plain(label, words.clock(a[at]), a[flight], *(v for _, v in words.alert_state(a, moment)), a[severity])
        for (label, moment), at, flight, severity in zip(
            moments,
            ("raised_at", "now_departed_at"),
            ("raised_flight_id", "now_flight_id"),
            ("raised_severity", "severity"),
            strict=True,
        )
    ]
    return table(("", "Departure", "After flight", *names, "Severity"), rows)


def _reasons(a: dict[str, Any]) -> list[Html]:
    """Why it stands now and, folded away, why it was raised; once where nothing has been measured since."""
    now = tag("p", tag("b", "Why: "), _marked(a["evidence_now"]))
    if a["evidence"] == a["evidence_now"]:
        return [now]
    return [now, tag("details", tag("summary", "Why it was raised"), tag("p", _marked(words.finding(a["evidence"]))))]


def _marked(evidence: str) -> Html:
    """Evidence with the role of its witnesses to be seen at a glance."""
    parts = re.split(rf"\b((?:{'|'.join((*ROLES, 'Else'))}):)", words.tidy(evidence))
    return join(*(tag("b", part) if i % 2 else part for i, part in enumerate(parts)))
