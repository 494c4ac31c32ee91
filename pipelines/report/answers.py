"""What stands beside an open alert: who has its case in hand, when the message is due, what to do at the next stop."""

from typing import Any

from pipelines.report import words
from pipelines.report.facts import Facts
from pipelines.words import _, number

Row = dict[str, Any]
CHOICES = {"wash": "wash", "replace": "replace", "defer": "defer to the check"}
STATUSES = {
    "no_check_planned": "no check is planned",
    "beyond_horizon": "the check lies beyond what is foretold",
    "contradicted": "the part was found clean: in doubt",
    "few_units": "too few such units on record",
    "no_rate": "how often it flies is not known",
    "no_cost": "costs.toml has no cost for it",
}
STATES = {
    "acknowledged": "seen", "muted": "muted until {day}", "worsened": "was muted, and is worse",
    "answered": "answered; the next night closes it", "confirmed": "confirmed, not mended yet",
}  # fmt: skip
"""A state of the view `cases` as a page says it; one that is new says nothing."""


def answers(facts: Facts, alert: Row) -> Row:
    """Sentences on an alert's case and its dates, and the choices at the next stop as rows of a table."""
    place = {c: alert[c] for c in ("operator", "tail", "pack", "component")}
    case = next(facts["cases"].filter(alert_id=alert["alert_id"]).iter_rows(named=True), None)
    due = next(facts["due"].filter(**place).iter_rows(named=True), None)
    stops = facts["stops"].filter(**place).to_dicts()
    said = [*(_of_case(case) if case else ()), *_came_back(alert), *(_of_dates(due) if due else ())]
    return {"said": said, "choices": [_choice(s) for s in stops]}


def _of_case(case: Row) -> list[str]:
    said = []
    if case["state"] in STATES:
        state, until = STATES[case["state"]], words.day(case["muted_until"])
        said.append(_("Case: {state}.", state=_(state, day=until)))
    if case["owner"]:
        said.append(_("In hand: {who}.", who=case["owner"]))
    if case["finding"]:
        found, on = case["finding"].lower().replace("_", " "), words.day(case["found_on"])
        said.append(_("{who} on {day}: {finding}.", who=case["found_by"], day=on, finding=_(found)))
    return said


def _came_back(alert: Row) -> list[str]:
    if alert["opened_on"] is None:
        return []
    opened = words.day(alert["opened_on"])
    return [_("Opened {day}, found clean; loss still rising: check the sensor.", day=opened)]


def _of_dates(due: Row) -> list[str]:
    if due["flights_per_day"] is None:
        return []
    rate = number(due["flights_per_day"], 1)
    if due["status"] == "beyond_horizon":
        days = number(due["days_left"])
        return [_("More than {days} days to the message, at {rate} flights a day.", days=days, rate=rate)]
    low, high = number(due["days_left_low"]), due["days_left_high"]
    known = {"days": number(due["days_left"]), "low": low, "rate": rate, "day": words.day(due["due_on"])}
    if high is None:
        said = _("About {days} days to the message ({low} or more), {day}, at {rate} flights a day.", **known)
    else:
        known["high"] = number(high)
        said = _("About {days} days to the message ({low} to {high}), {day}, at {rate} flights a day.", **known)
    return [said, _("The part was found clean since: in doubt.")] if due["status"] == "contradicted" else [said]


def _choice(stop: Row) -> list[str]:
    """One row: what, until when, with what chance, at what cost, and what is to be said of that."""
    chance = words.chance(stop["chance"])
    if stop["chance_at_least"] is not None:
        chance = _("more than {chance}", chance=words.chance(stop["chance_at_least"]))
    expected = stop["expected_cost"]
    cost = words.DASH if expected is None else f"{number(expected)} {stop['currency']}"
    until = " ".join(filter(None, (stop["check_name"], words.day(stop["until_on"]))))
    choice = str(CHOICES.get(stop["choice"], stop["choice"]))
    status = STATUSES.get(stop["status"], "")
    return [_(choice), until, chance, cost, _(status)]
