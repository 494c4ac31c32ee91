"""Build the report's first screen: a table with a pack, or a unit of another component, a row."""

import re
from collections.abc import Iterator, Mapping
from datetime import date, datetime, timedelta
from typing import Any

import polars as pl

from hdt_core.components import components
from pipelines.report import words
from pipelines.report.facts import Facts
from pipelines.report.tasks import ACTIONS, action_of, tasks_of
from pipelines.report.tracks import card_id
from pipelines.words import _, format_count, number, several

Row = dict[str, Any]
AXIS_DAYS = 120
"""Days that the axis of due dates shows."""
SPARK_POINTS, SPARK_WIDTH, SPARK_HEIGHT = 40, 90, 26


def tonight(facts: Facts, tracks: Mapping[str, Row], fouling_limit: float) -> dict[str, Any]:
    """Return the summary, the rows to act on or plan, the other rows, and what is not known.

    `tracks` holds the data of each card's chart by the card's id; `fouling_limit` is the loss that raises an alert.
    """
    ranking, units = facts["ranking"].to_dicts(), facts["components"].to_dicts()
    limits = {c.code: c.warn_loss for c in components().values()} | {"HX": fouling_limit}
    alerts = facts["alerts"].filter(pl.col("closed_at").is_null())
    pack_alerts = alerts.filter(~pl.col("component").is_in(facts["components"]["component"].unique().to_list()))
    rows = [_row(facts, tracks, limits, r, pack_alerts) for r in ranking]
    rows += [_row(facts, tracks, limits, r, alerts.filter(component=r["component"])) for r in units]
    act, plan = (sum(r["urgency"] == u for r in ranking) for u in ("act", "plan"))
    silent = facts["gaps"].filter(gap="silent_now").to_dicts()
    return {
        "summary": _summary(act, plan, len(ranking)) if ranking else None,
        "rows": [r for r in rows if r["urgency"] in ("act", "plan")],
        "rest": [r for r in rows if r["urgency"] not in ("act", "plan")],
        "ticks": _ticks(facts.until()),
        "unknown": words.unknown([*ranking, *units]),
        "silent": "; ".join(_("{tail} since {day}", tail=g["tail"], day=words.day(g["from_at"])) for g in silent),
        "flights": _flights_line(facts),
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


def _row(
    facts: Facts, tracks: Mapping[str, Row], limits: Mapping[str, float], row: Row, open_alerts: pl.DataFrame
) -> Row:
    """Return the cells of a pack or unit; chance and date are those of the component whose message is likelier."""
    own, key = "name" in row, words.unit_key(row)
    code = row["component"] if own else "HX"
    card = card_id(row)
    outlook = words.likeliest_outlook(facts["outlooks"], row)
    alerts = open_alerts.filter(operator=row["operator"], tail=row["tail"], pack=row["pack"]).to_dicts()
    margins = facts.of_pack("margins", *key).to_dicts() if not own and not row["work_action"] else []
    return {
        **{k: row[k] for k in ("operator", "urgency", "place")},
        **(margins[0] if margins else {"margin_k": None, "door_share": None}),
        "name": words.unit_name(row),
        "card": card,
        "unit": (*key, code) if own else key,
        "alerts": alerts,
        "limit": limits[code],
        "find": words.search_text(row, row["diagnoses"]),
        "notes": list(_notes(facts, row, outlook, alerts)),
        "loss": row["loss" if own else "hx_fouling"],
        "loss_text": words.loss(row),
        "spark": _spark(tracks[card]["own"], limits[code]) if card in tracks else None,
        "flights": outlook["rul_flights"],
        "flights_text": words.flights_left(outlook),
        "due": _due(outlook, facts.until()) if outlook["due_low_on"] else None,
        "chance": words.chance_before_check(outlook),
        "chance_text": words.chance_by(outlook),
        "to_do": _to_do(facts, row, alerts),
    }


def _notes(facts: Facts, row: Row, outlook: Row, alerts: list[Row]) -> Iterator[str]:
    """Yield open alerts, work since the last flight, and since when the aircraft is silent."""
    for a in alerts:
        day = words.day(a["raised_at"])
        yield _("{diagnosis} since {day}", diagnosis=words.diagnosis(a["diagnosis"]), day=day)
    if outlook["component"] == "CC":
        loss, whose = row["cc_efficiency_loss"], _("flights left are the compressor's")
        yield whose if loss is None else _("{whose}: {loss} lost", whose=whose, loss=words.percent(loss, 1))
    if row["work_action"]:
        yield words.work_done(row)
    for day in facts["gaps"].filter(gap="silent_now", operator=row["operator"], tail=row["tail"])["from_at"]:
        yield _("no flight since {day}", day=words.day(day))


def _spark(own: Row, limit: float) -> Row:
    """Return the points of a small line of the loss [%] and the height of the alert's limit."""
    values = own["y"][:: -(-len(own["y"]) // SPARK_POINTS)] + own["y"][-1:]
    top = 1.1 * max([100.0 * limit, *values])
    bottom = min([-0.1 * top, *values])
    heights = [SPARK_HEIGHT * (top - v) / (top - bottom) for v in (*values, 100.0 * limit)]
    step = SPARK_WIDTH / max(len(values) - 1, 1)
    return {
        "line": " ".join(f"{k * step:.1f},{y:.1f}" for k, y in enumerate(heights[:-1])),
        "limit": round(heights[-1], 1),
        "size": (SPARK_WIDTH, SPARK_HEIGHT),
    }


def _due(outlook: Row, until: datetime) -> Row:
    """Return where date, interval and next check lie on the axis [%], the date, and whether it has passed."""
    low, due, high, check = (_place(outlook[k], until) for k in ("due_low_on", "due_on", "due_high_on", "check_on"))
    dated = outlook["due_status"] != "beyond_horizon"
    day = words.day(outlook["due_on"] if dated else outlook["due_low_on"])
    return {
        "low": low,
        "width": max((100.0 if high is None else high) - (low or 0.0), 1.0),
        "mark": due if dated else None,
        "check": check,
        "text": day if dated else _("after {day}", day=day),
        "overdue": dated and outlook["due_on"] < until.date(),
    }


def _place(day: date | None, until: datetime) -> float | None:
    return None if day is None else min(max(100.0 * (day - until.date()).days / AXIS_DAYS, 0.0), 100.0)


def _ticks(until: datetime | None) -> list[tuple[float | None, str]]:
    """Return places [%] and dates of the first of each month on the axis of due dates."""
    days = [until.date() + timedelta(days=n) for n in range(AXIS_DAYS)] if until else []
    return [(_place(d, until), f"{d:%m-%d}") for d in days if until and d.day == 1]


def _to_do(facts: Facts, row: Row, alerts: list[Row]) -> tuple[str, str]:
    """Return the one action, and its work and what it and deferring it are expected to cost where that is known."""
    stops = facts.of_pack("stops", *words.unit_key(row))
    code = alerts[0]["component"] if alerts else row.get("component", "HX")
    best = next(stops.filter(component=code, place=1).iter_rows(named=True), None)
    alert = alerts[0] if alerts else {"diagnosis": code, "component": code, "recommended_action": ""}
    tasks = tasks_of(facts.tasks, alert)
    action = action_of(alert | {"choice": best["choice"] if best else None}, tasks)
    acts = row["urgency"] in ("act", "plan")
    text = _(ACTIONS[action]).capitalize() if best and acts and action != "inspect" else _short_action(alert)
    effort = tasks[action].effort() if alerts and action in tasks else ""
    return text, "; ".join(filter(None, (effort, _cost(best) if best and acts else "")))


def _short_action(alert: Row) -> str:
    """Return the first clause of an alert's recommended action."""
    return re.split(r" \(|; |\. |\.$", words.plain(alert["recommended_action"]))[0]


def _cost(best: Row) -> str:
    cost = _("{cost} {currency} to expect", cost=number(best["expected_cost"]), currency=best["currency"])
    if best["choice"] == "defer" or best["defer_cost"] is None:
        return cost
    return _("{cost}, {more} deferred", cost=cost, more=number(best["defer_cost"]))


def _flights_line(facts: Facts) -> str:
    """Return the number of flights and the last one."""
    flights = facts["flights"]
    if not flights.height:
        return _("No flight yet.")
    return several(
        "{n} flight of {aircraft} aircraft; the last left on {last}.",
        "{n} flights of {aircraft} aircraft; the last left on {last}.",
        flights.height,
        aircraft=format_count(flights.select("operator", "tail").n_unique()),
        last=words.clock(facts.until()),
    )
