"""Build the card of each unit: its chart, and for each open alert its case, due date and choices at the next stop."""

from collections.abc import Mapping
from typing import Any

import polars as pl

from pipelines.report import words
from pipelines.report.facts import Facts
from pipelines.report.tasks import ACTIONS, Task, action_of, tasks_of
from pipelines.report.tonight import tonight
from pipelines.report.tracks import drawing, fleet_band, tracks
from pipelines.words import _, number

Row = dict[str, Any]
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
