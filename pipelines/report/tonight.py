"""Build the report's first screen, a table with a pack, or a unit of another component, a row; and the card of each."""

import re
from collections.abc import Iterator, Mapping
from datetime import date, datetime, timedelta
from typing import Any

import polars as pl

from hdt_core.components import components
from pipelines.report import words
from pipelines.report.facts import Facts
from pipelines.report.tasks import ACTIONS, Task, action_of, tasks_of
from pipelines.report.tracks import card_id, drawing, fleet_band, tracks
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
        "chance_text": words.message_on_record(row) or words.chance_by(outlook),
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
    if off := words.switched_off(row):
        yield off
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


STATUSES = {
    "beyond_horizon": "the check lies beyond the forecast",
    "contradicted": "the part was found clean: doubtful",
    "few_units": "too few such units on record",
    "no_rate": "flight rate unknown",
    "no_cost": "costs.toml has no cost for it",
}
STATES = {
    "acknowledged": "acknowledged", "muted": "muted until {day}", "worsened": "muted, now worse",
    "answered": "answered; the next night closes it", "confirmed": "confirmed, not repaired yet",
}  # fmt: skip
"""Labels of the states of the view `cases`; a new case has none."""


def tonight_with_cards(facts: Facts, fouling_limit: float) -> Row:
    """Return the table of `tonight`, the card of each of its rows, and how often alerts of each kind were right."""
    charts, fleet = tracks(facts), fleet_band(facts)
    table = tonight(facts, charts, fouling_limit)
    return table | {
        "cards": [_card(facts, row, charts, fleet) for row in (*table["rows"], *table["rest"])],
        "hit_rates": {r["diagnosis"]: r for r in facts["hit_rates"].to_dicts()},
    }


def _card(facts: Facts, row: Row, charts: Mapping[str, Row], fleet: Row) -> Row:
    """Return the card of a row: open alerts, the chart where the unit has one, and its latest events."""
    has_chart = row["card"] in charts
    events = sorted(charts[row["card"]]["events"], key=lambda m: m["x"], reverse=True) if has_chart else []
    return row | {
        "alerts": [a | answers(facts, a) for a in row["alerts"]],
        "chart": drawing(charts, row["card"], fleet, row["limit"]) if has_chart else None,
        "events": list(dict.fromkeys(m["text"] for m in events))[:3],
    }


def answers(facts: Facts, alert: Row) -> Row:
    """Return sentences on an alert's case and on its dates, and the choices at the next stop as rows of a table."""
    unit = {c: alert[c] for c in ("operator", "tail", "pack", "component")}
    case = next(facts["cases"].filter(alert_id=alert["alert_id"]).iter_rows(named=True), None)
    due = next(facts["outlooks"].filter(pl.col("due_status").is_not_null(), **unit).iter_rows(named=True), None)
    stops = {s["choice"]: s for s in facts["stops"].filter(**unit).to_dicts()}
    tasks = tasks_of(facts.tasks, alert)
    best = next((s["choice"] for s in stops.values() if s["place"] == 1), None)
    first = action_of(alert | {"choice": best}, tasks)
    order = sorted(ACTIONS, key=lambda a: (a != first, stops.get(a, {}).get("place") or len(ACTIONS)))
    return {
        "case": _case_lines(case) if case else [],
        "sentences": [*_recurrence(alert), *(_due_lines(due) if due else ())],
        "until": next(map(_until, stops.values()), words.DASH),
        "choices": [_choice(a, tasks.get(a), stops) for a in order if a in stops or a in tasks],
    }


def _case_lines(case: Row) -> list[str]:
    lines = []
    if case["state"] in STATES:
        state, until = STATES[case["state"]], words.day(case["muted_until"])
        lines.append(_("Case: {state}.", state=_(state, day=until)))
    if case["owner"]:
        lines.append(_("Owner: {who}.", who=case["owner"]))
    if case["finding"]:
        finding, on = case["finding"].lower().replace("_", " "), words.day(case["found_on"])
        lines.append(_("{who} on {day}: {finding}.", who=case["found_by"], day=on, finding=_(finding)))
    return lines


def _recurrence(alert: Row) -> list[str]:
    if alert["opened_on"] is None:
        return []
    opened = words.day(alert["opened_on"])
    return [_("Opened {day}, found clean; loss still rising: check the sensor.", day=opened)]


def _due_lines(due: Row) -> list[str]:
    if due["flights_per_day"] is None:
        return []
    rate = number(due["flights_per_day"], 1)
    if due["due_status"] == "beyond_horizon":
        days = number(due["days_left"])
        return [_("More than {days} days to the message, at {rate} flights a day.", days=days, rate=rate)]
    low, high = number(due["days_left_low"]), due["days_left_high"]
    values = {"days": number(due["days_left"]), "low": low, "rate": rate, "day": words.day(due["due_on"])}
    if high is None:
        line = _("About {days} days to the message ({low} or more), {day}, at {rate} flights a day.", **values)
    else:
        values["high"] = number(high)
        line = _("About {days} days to the message ({low} to {high}), {day}, at {rate} flights a day.", **values)
    return [line, _("The part was found clean since: doubtful.")] if due["due_status"] == "contradicted" else [line]


def _until(stop: Row) -> str:
    """Return the check and its day, or the day and that no check is planned."""
    if stop["check_name"]:
        return f"{stop['check_name']} {words.day(stop['until_on'])}"
    return _("{day} (no check is planned)", day=words.day(stop["until_on"]))


def _choice(action: str, task: Task | None, stops: Mapping[str, Row]) -> list[str]:
    """Return one row: choice, chance of a message, expected cost, work.

    An inspection alone changes no chance, so it has that of deferring, and no cost of its own.
    """
    stop = stops.get(action) or stops.get("defer", {}) | {"expected_cost": None, "status": "ok"}
    chance = words.chance(stop.get("chance"))
    if stop.get("chance_at_least") is not None:
        chance = _("more than {chance}", chance=words.chance(stop["chance_at_least"]))
    expected = stop["expected_cost"]
    cost = words.DASH if expected is None else f"{number(expected)} {stop['currency']}"
    remark = _(STATUSES.get(stop["status"], ""))
    return [_(ACTIONS[action]), chance, cost, "; ".join(filter(None, (task.text() if task else "", remark)))]
