"""Who needs attention, in order, and why."""

from datetime import timedelta
from typing import Any

import polars as pl

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
    """Open alerts in full; those closed lately in a line each, folded away until they are asked for."""
    rows = facts["alerts"]
    if not rows.height:
        return tag("p", "No alert has been raised.", class_="empty")
    order = {"high": 0, "medium": 1, "low": 2}
    opened = rows.filter(pl.col("closed_at").is_null()).to_dicts()
    opened.sort(key=lambda a: (order.get(a["severity"], 3), -a["raised_at"].timestamp()))
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
            a["severity"],
            words.tidy(a["evidence"]),
        )
        for a in late.to_dicts()
    ]
    older = rows.height - late.height
    return tag(
        "details",
        tag("summary", f"{words.count(late.height, 'alert')} closed in the last {CLOSED_DAYS} days"),
        table(
            ("Raised", "Closed", "Pack", "What", "Severity", "Evidence"),
            body,
            finds=[words.found_by(a, a["diagnosis"]) for a in late.to_dicts()],
        ),
        tag("p", f"{words.count(older, 'older alert')} in the catalog, view alerts.", class_="small")
        if older
        else None,
    )


def _alert(a: dict[str, Any]) -> Html:
    severity = tag("span", a["severity"], class_=f"tag {a['severity']}")
    raised = f"raised after {a['raised_flight_id']}, {words.clock(a['raised_at'])}"
    return tag(
        "article",
        tag("h3", words.pack_name(a), ": ", words.diagnosis(a["diagnosis"]), " ", severity),
        tag("p", tag("b", "To do: "), words.tidy(a["recommended_action"])),
        tag("p", tag("b", "Why: "), words.tidy(a["evidence"])),
        tag("p", f"{a['operator']}, {raised}; case {a['alert_id']}.", class_="small"),
        class_="card alert",
        data_find=words.found_by(a, a["diagnosis"]),
    )
