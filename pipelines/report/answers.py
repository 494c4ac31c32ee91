"""Write what stands beside an open alert: its case, when its message is due, and the choices at the next stop."""

from typing import Any

import polars as pl

from pipelines.report import words
from pipelines.report.facts import Facts
from pipelines.words import _, number

Row = dict[str, Any]
CHOICES = {"wash": "wash", "replace": "replace", "defer": "defer to the check"}
STATUSES = {
    "no_check_planned": "no check is planned",
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


def answers(facts: Facts, alert: Row) -> Row:
    """Return sentences on an alert's case and dates, and the choices at the next stop as rows of a table."""
    unit = {c: alert[c] for c in ("operator", "tail", "pack", "component")}
    case = next(facts["cases"].filter(alert_id=alert["alert_id"]).iter_rows(named=True), None)
    due = next(facts["outlooks"].filter(pl.col("due_status").is_not_null(), **unit).iter_rows(named=True), None)
    stops = facts["stops"].filter(**unit).to_dicts()
    sentences = [*(_case_lines(case) if case else ()), *_recurrence(alert), *(_due_lines(due) if due else ())]
    return {"sentences": sentences, "choices": [_choice(s) for s in stops]}


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


def _choice(stop: Row) -> list[str]:
    """Return one row: choice, until when, chance of a message, expected cost, remark."""
    chance = words.chance(stop["chance"])
    if stop["chance_at_least"] is not None:
        chance = _("more than {chance}", chance=words.chance(stop["chance_at_least"]))
    expected = stop["expected_cost"]
    cost = words.DASH if expected is None else f"{number(expected)} {stop['currency']}"
    until = " ".join(filter(None, (stop["check_name"], words.day(stop["until_on"]))))
    choice = str(CHOICES.get(stop["choice"], stop["choice"]))
    status = STATUSES.get(stop["status"], "")
    return [_(choice), until, chance, cost, _(status)]
