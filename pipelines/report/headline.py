"""Write the report's first lines: what to do tonight."""

from collections.abc import Iterator
from typing import Any

import polars as pl

from pipelines.report import words
from pipelines.report.facts import Facts
from pipelines.report.templating import anchor
from pipelines.words import _, several

Row = dict[str, Any]


def headline(facts: Facts) -> dict[str, Any]:
    """Return work due now with its action, work to plan, packs without an estimate, and silent aircraft."""
    rows = facts["ranking"].to_dicts()
    units = facts["components"].to_dicts()
    act, plan = ([r for r in rows if r["urgency"] == u] for u in ("act", "plan"))
    return {
        "summary": _summary(len(act), len(plan), len(rows)) if rows else None,
        "lists": [[_item(facts, r) for r in some] for some in (act, plan)],
        "units": [r for r in units if r["urgency"] in ("act", "plan")],
        "unknown": words.unknown([*rows, *units]),
        "silent": "; ".join(
            _("{tail} since {day}", tail=g["tail"], day=words.day(g["from_at"]))
            for g in facts["gaps"].filter(gap="silent_now").to_dicts()
        ),
        "flights": flights_line(facts),
    }


def _summary(act: int, plan: int, n: int) -> str:
    watched = several("{n} pack watched", "{n} packs watched", n)
    if not act and not plan:
        return _("Nothing to do tonight. {watched}, none with an open alert.", watched=watched)
    first = (
        several("{n} pack needs work now", "{n} packs need work now", act)
        if act
        else _("Nothing has to be done tonight")
    )
    later = several(", {n} pack to plan for", ", {n} packs to plan for", plan) if plan else ""
    return f"{first}{later}. {watched}."


def _item(facts: Facts, row: Row) -> Row:
    """Return a pack with its alerts, forecast and action."""
    key = words.unit_key(row)
    alerts = facts.of_pack("alerts", *key).filter(pl.col("closed_at").is_null()).to_dicts()
    wears = any(a["component"] in words.WEARS for a in alerts)
    return {
        "name": words.pack_name(row),
        "card": anchor("pack", *key),
        "find": words.search_text(row, row["diagnoses"]),
        "outlook": _outlook(row) if wears or not alerts else "",
        "alerts": "; ".join(
            _("{diagnosis} since {day}", diagnosis=words.diagnosis(a["diagnosis"]), day=words.day(a["raised_at"]))
            for a in alerts
        ),
        "todo": _(". Then: ").join(dict.fromkeys(_todo(alerts))),
    }


def _todo(alerts: list[Row]) -> Iterator[str]:
    """Yield the action of each alert; a first step that they share appears once."""
    first = set[str]()
    for a in alerts:
        action = words.plain(a["recommended_action"]).rstrip(".")
        before, then, rest = action.partition(_(". Only then: "))
        yield rest if then and before in first else action
        first.add(before)


def _outlook(row: Row) -> str:
    p = row["p_event_50"]
    if (row["cc_p_event_50"] or 0) > (p or 0):
        return _("chance of a compressor message within 50 flights {chance}", chance=words.chance(row["cc_p_event_50"]))
    return _(
        "UA lost {loss}, flights left {left}, chance of a message within 50 flights {chance}",
        loss=words.loss(row),
        left=words.flights_left(row),
        chance=words.chance(p),
    )


def flights_line(facts: Facts) -> str:
    """Return the number of flights and the last one."""
    flights = facts["flights"]
    if not flights.height:
        return _("No flight yet.")
    return several(
        "{n} flight of {aircraft} aircraft; the last left on {last}.",
        "{n} flights of {aircraft} aircraft; the last left on {last}.",
        flights.height,
        aircraft=words.count(flights.select("operator", "tail").n_unique()),
        last=words.clock(facts.until()),
    )
