"""Build the report's first screen, a table with a pack, or a unit of another component, a row; and the card of each."""

from collections.abc import Mapping
from datetime import date, datetime, timedelta
from typing import Any

import polars as pl

from hdt_core.components import components
from pipelines.report import words
from pipelines.report.facts import Facts
from pipelines.report.rows import UnitRow, silence_lines, subject_of
from pipelines.report.tasks import ACTIONS, Task, action_of, choices_of, tasks_of
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
    packs = [unit for unit in facts.rows if unit["component"] is None]
    limits = {c.code: c.warn_loss for c in components().values()} | {"HX": fouling_limit}
    rows = [_row(facts, tracks, limits, unit) for unit in facts.rows]
    n_act = sum(unit["urgency"] == "act" for unit in packs)
    n_plan = sum(unit["urgency"] == "plan" for unit in packs)
    return {
        "summary": _summary(n_act, n_plan, len(packs)) if packs else None,
        "rows": [r for r in rows if r["needs_work"]],
        "rest": [r for r in rows if not r["needs_work"]],
        "ticks": _ticks(facts.until()),
        "unknown": words.unknown([unit.values for unit in facts.rows]),
        "silent": silence_lines(facts.rows),
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


def _row(facts: Facts, tracks: Mapping[str, Row], limits: Mapping[str, float], unit: UnitRow) -> Row:
    """Return the cells of a unit's row."""
    card = card_id(unit.values)
    limit = limits[unit["component"] or "HX"]
    open_alerts = facts["alerts"].filter(pl.col("closed_at").is_null()).iter_rows(named=True)
    alerts = list(filter(unit.owns, open_alerts))
    return {
        **{
            k: unit[k]
            for k in ("operator", "tail", "pack", "urgency", "place", "loss", "margin_k", "door_share", "chance")
        },
        "name": words.unit_name(unit.values),
        "card": card,
        "component": unit["outlook_component"] or unit["component"] or "HX",
        "unit": unit.key,
        "alerts": alerts,
        "limit": limit,
        "find": words.search_text(unit.values, unit["diagnoses"]),
        "needs_work": unit.needs_work,
        "since": unit.since(),
        "notes": [*map(_since, alerts), *unit.notes(), *filter(None, [unit.silence()])],
        "loss_text": unit.loss(),
        "spark": _spark(tracks[card]["own"], limit) if card in tracks else None,
        "flights": unit["rul_flights"],
        "flights_text": unit.flights_left(),
        "due": _due(unit, facts.until()) if unit["due_low_on"] else None,
        "chance_text": unit.message(),
        "message_phrase": unit.message_phrase(),
        "to_do": (unit.to_do(), "; ".join(filter(None, (unit.effort(), unit.cost())))),
        "subject": {c: unit[c] for c in ("operator", "tail", "pack", "came_at")} | subject_of(unit.values),
    }


def _since(alert: Row) -> str:
    label = words.diagnosis(alert["diagnosis"])
    return _("{diagnosis} since {day}", diagnosis=label, day=words.day(alert["raised_at"]))


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


def _due(unit: UnitRow, until: datetime) -> Row:
    """Return where date, interval and next check lie on the axis [%], the date, and whether it has passed."""
    check_on = unit["until_on"] if unit["check_name"] else None
    places = [_place(day, until) for day in (unit["due_low_on"], unit["due_on"], unit["due_high_on"], check_on)]
    low, due, high, check = places
    return {
        "low": low,
        "width": max((100.0 if high is None else high) - (low or 0.0), 1.0),
        "mark": None if unit["is_bound"] else due,
        "check": check,
        "text": unit.due(),
        "overdue": unit["is_overdue"],
    }


def _place(day: date | None, until: datetime) -> float | None:
    return None if day is None else min(max(100.0 * (day - until.date()).days / AXIS_DAYS, 0.0), 100.0)


def _ticks(until: datetime | None) -> list[tuple[float | None, str]]:
    """Return places [%] and dates of the first of each month on the axis of due dates."""
    days = [until.date() + timedelta(days=n) for n in range(AXIS_DAYS)] if until else []
    return [(_place(d, until), f"{d:%m-%d}") for d in days if until and d.day == 1]


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
    "no_rate": "flight rate unknown",
    "no_cost": "costs.toml has no cost for it",
}


def tonight_with_cards(facts: Facts, fouling_limit: float) -> Row:
    """Return the table of `tonight`, the card of each of its rows, and how often alerts of each kind were right."""
    charts = tracks(facts)
    fleet = fleet_band(facts)
    table = tonight(facts, charts, fouling_limit)
    return table | {
        "cards": [_card(facts, row, charts, fleet) for row in (*table["rows"], *table["rest"])],
        "hit_rates": {r["diagnosis"]: r for r in facts["hit_rates"].to_dicts()},
    }


def _card(facts: Facts, row: Row, charts: Mapping[str, Row], fleet: Row) -> Row:
    """Return the card of a row: open alerts, the chart where the unit has one, and its latest events.

    A unit that needs work without an open alert has the choices at its next `stop`.
    """
    has_chart = row["card"] in charts
    events = sorted(charts[row["card"]]["events"], key=lambda m: m["x"], reverse=True) if has_chart else []
    reference = facts["references"].filter(**{c: row[c] for c in ("operator", "tail", "pack", "component")})
    return row | {
        "reference": words.reference(next(reference.iter_rows(named=True), None)),
        "alerts": [a | answers(facts, a) for a in row["alerts"]],
        "stop": _next_stop(facts, row["subject"]) if row["needs_work"] and not row["alerts"] else None,
        "chart": drawing(charts, row["card"], fleet, row["limit"]) if has_chart else None,
        "events": list(dict.fromkeys(m["text"] for m in events))[:3],
    }


def answers(facts: Facts, alert: Row) -> Row:
    """Return sentences on an alert's case and on its dates, and the choices at the next stop as rows of a table."""
    case = next(facts["cases"].filter(alert_id=alert["alert_id"]).iter_rows(named=True), None)
    stop = _next_stop(facts, alert | {"came_at": alert["now_came_at"]})
    sentences = [*_recurrence(alert), *stop["sentences"]]
    return stop | {"case": _case_lines(case) if case else [], "sentences": sentences}


def _next_stop(facts: Facts, subject: Row) -> Row:
    """Return sentences on the dates of a unit's alert, or of the unit, and the choices at the next stop."""
    unit = {c: subject[c] for c in ("operator", "tail", "pack", "component")}
    due = next(facts["due"].filter(**unit).iter_rows(named=True), None)
    stops = {s["choice"]: s for s in facts["stops"].filter(**unit).to_dicts()}
    tasks = tasks_of(facts.tasks, subject)
    known = choices_of(subject["component"], tasks)
    best = next((s["choice"] for s in stops.values() if s["place"] == 1), None)
    first = action_of(subject | {"choice": best}, tasks)
    order = sorted(ACTIONS, key=lambda a: (a != first, stops.get(a, {}).get("place") or len(ACTIONS)))
    return {
        "sentences": _due_lines(due) if due and subject["came_at"] is None else [],
        "until": next(map(_until, stops.values()), ""),
        "choices": [_choice(a, tasks.get(a), stops) for a in order if a in (stops.keys() | tasks) & known],
    }


def _case_lines(case: Row) -> list[str]:
    state = words.case_state({"case_state": case["state"], **case})
    lines = [_("Case: {state}.", state=state)] if state else []
    if case["finding"]:
        finding = case["finding"].lower().replace("_", " ")
        on = words.day(case["found_on"])
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
    if due["status"] == "beyond_horizon":
        days = number(due["days_left"])
        return [_("More than {days} days to the message, at {rate} flights a day.", days=days, rate=rate)]
    low = number(due["days_left_low"])
    high = due["days_left_high"]
    values = {"days": number(due["days_left"]), "low": low, "rate": rate, "day": words.day(due["due_on"])}
    if high is None:
        line = _("About {days} days to the message ({low} or more), {day}, at {rate} flights a day.", **values)
    else:
        values["high"] = number(high)
        line = _("About {days} days to the message ({low} to {high}), {day}, at {rate} flights a day.", **values)
    return [line, _("The part was found clean since: doubtful.")] if due["status"] == "contradicted" else [line]


def _until(stop: Row) -> str:
    """Return the check and its day, or the day until which no check is planned; empty where there is none."""
    if stop["until_on"] is None:
        return ""
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
    basis = _basis(stop["rests_on"]) if action == "wash" and stop.get("rests_on") else ""
    remark = "; ".join(filter(None, (_(STATUSES.get(stop["status"], "")), basis)))
    name = (
        _("nothing until {until}", until=_until(stop))
        if action == "defer" and stop.get("until_on")
        else _(ACTIONS[action])
    )
    return [name, chance, cost, "; ".join(filter(None, (task.text() if task else "", remark)))]


def _basis(rests_on: str) -> str:
    """Format what the effect of a wash rests on: the declared prior, or `12 washes`."""
    if rests_on == "prior":
        return _("effect of a wash as declared, too few on record")
    return _("effect of a wash by {washes}", washes=rests_on)
