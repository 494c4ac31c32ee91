"""The row of a unit in every output: its values, those of the view `unit_rows`, and the words for them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import duckdb

from hdt_core.components import components
from pipelines.report import words
from pipelines.report.tasks import Task, Tasks, action_of, describe_action, read_tasks, tasks_of
from pipelines.storage.catalog import fetch_dicts, nights_of
from pipelines.storage.catalog_checks import connect_current
from pipelines.words import _, number
from pipelines.words.evidence import stored_action

Row = dict[str, Any]
_ROWS = "select * from unit_rows order by component is not null, place"
_CHOICES = "select * from next_stop order by place nulls last, choice"


@dataclass(frozen=True, slots=True)
class UnitRow:
    """A pack or a unit of another component.

    Attributes
    ----------
    values : dict
        Its row of the view `unit_rows`; `choices` are its rows of `next_stop`, the cheapest first.
    tasks : mapping
        Work of each action of its most urgent alert or, without one, of its component.
    """

    values: Row
    tasks: Mapping[str, Task]

    def __getitem__(self, name: str) -> Any:
        return self.values[name]

    @property
    def key(self) -> tuple[Any, ...]:
        """Operator, tail and pack; of a unit that is no pack's its component, too."""
        return unit_key(self.values)

    @property
    def needs_work(self) -> bool:
        """Whether it is to act on or to plan, and not only by a forecast that an inspection has answered."""
        is_answered = self["is_contradicted"] and self["alert_id"] is None
        return self["urgency"] in ("act", "plan") and not is_answered

    def owns(self, alert: Row) -> bool:
        """Whether an alert is of this unit: one of a pack's parts of the pack."""
        declared = alert["component"] if alert["component"] in words.DECLARED else None
        return words.unit_key(alert) == self.key[:3] and declared == self["component"]

    def name(self) -> str:
        """Format the unit: `AQX LX-AAC pack 2 (right)`."""
        return f"{self['operator']} {words.unit_name(self.values)}"

    def urgency(self) -> str:
        """Format urgency and since when: `Act now since 2024-06-10`."""
        return " ".join(filter(None, (words.urgency(self.values), self.since())))

    def since(self) -> str:
        """Format since when it is to act on, and that the fleet's record brought it; empty where it is not."""
        if self["urgency"] != "act" or self["urgent_since"] is None:
            return ""
        since = _("since {day}", day=words.day(self["urgent_since"]))
        by_fleet = _("by the fleet's record")
        return f"{since} ({by_fleet})" if self["urgent_by"] == "fleet" else since

    def diagnosis(self) -> str:
        """Format the diagnoses of the open alerts; empty where none is open."""
        return words.diagnosis(self["diagnoses"]) if self["diagnoses"] else ""

    def loss(self) -> str:
        """Format the loss with its interval."""
        return words.share(self["loss"], self["loss_sd"])

    def flights_left(self) -> str:
        """Format flights left with their interval, or the lower end alone."""
        return words.flights_left(self.values)

    def due(self) -> str:
        """Format the day of the message, or the one before which it is not expected; empty where none is known."""
        if self["due_low_on"] is None:
            return ""
        bound = _("after {day}", day=words.day(self["due_low_on"]))
        return bound if self["is_bound"] else words.day(self["due_on"])

    def message(self) -> str:
        """Format the message on record that nothing has answered, else the chance of one."""
        return words.message_on_record(self.values) or words.chance_by(self.values)

    def message_phrase(self) -> str:
        """Format the same with its noun, for a line that has no column of messages: `message 52 % by 2024-07-15`."""
        return words.message_on_record(self.values) or _("message {chance}", chance=words.chance_by(self.values))

    def silence(self) -> str:
        """Format since when the aircraft sends nothing; empty where that is nothing unusual."""
        return (self["silent_since"] and _("no flight since {day}", day=words.day(self["silent_since"]))) or ""

    def notes(self) -> list[str]:
        """Format work and findings since the last flight, that the pack is off, and the state of its case."""
        clean_on = self["found_clean_on"]
        clean = clean_on and _("found clean on {day}, no flight since", day=words.day(clean_on))
        doubtful = _("the part was found clean: doubtful") if self["is_contradicted"] and not clean_on else ""
        other_part = _("flights left are the compressor's") if self["outlook_component"] == "CC" else ""
        state = words.case_state(self.values)
        unseen = words.not_seen(self.values)
        off = words.switched_off(self.values)
        notes = (doubtful, other_part, words.work_done(self.values), clean, off, unseen, state)
        return [note for note in notes if note]

    def action(self) -> str:
        """Return the code of the one thing to do, of `tasks.ACTIONS`; empty where there is nothing to do."""
        if not self.needs_work:
            return ""
        priced = [choice["choice"] for choice in self["choices"] or () if choice["expected_cost"] is not None]
        cheapest = priced[0] if priced else None
        return action_of(subject_of(self.values) | {"choice": cheapest}, self.tasks)

    def to_do(self) -> str:
        """Format the one thing to do in less than fifteen words; empty where there is nothing to do."""
        action = self.action()
        return action and describe_action(action, subject_of(self.values), self.until())

    def until(self) -> str:
        """Format the next planned check, or the day until which the chance is given."""
        return " ".join(filter(None, (self["check_name"], words.day(self["until_on"]))))

    def effort(self) -> str:
        """Format time and people of the thing to do."""
        action = self.action()
        return self.tasks[action].effort() if action in self.tasks else ""

    def cost(self) -> str:
        """Format the expected cost of the thing to do, and of waiting: `3,516 USD expected, 28,709 if it waits`."""
        choices = {choice["choice"]: choice for choice in self["choices"] or ()}
        own = choices.get(self.action(), {}).get("expected_cost")
        waiting = choices.get("defer", {}).get("expected_cost")
        if own is None:
            return ""
        cost = _("{cost} {currency} expected", cost=number(own), currency=choices[self.action()]["currency"])
        if waiting is None or self.action() == "defer":
            return cost
        return _("{cost}, {more} if it waits", cost=cost, more=number(waiting))

    def work(self, *, with_effort: bool = True) -> str:
        """Format the thing to do with its effort and cost; empty where there is nothing to do."""
        effort = self.effort() if with_effort else ""
        return "; ".join(filter(None, (self.to_do(), effort, self.cost())))


def unit_key(row: Row) -> tuple[Any, ...]:
    """Return operator, tail and pack; of a unit that is no pack's its component, too."""
    pack = words.unit_key(row)
    return pack if row["component"] is None else (*pack, row["component"])


def read_rows(con: duckdb.DuckDBPyConnection, tasks: Tasks) -> list[UnitRow]:
    """Read the rows of all units, packs first, the most urgent first."""
    choices: dict[tuple[Any, ...], list[Row]] = {}
    for choice in fetch_dicts(con.execute(_CHOICES)):
        choices.setdefault((*words.unit_key(choice), choice["component"]), []).append(choice)
    rows = fetch_dicts(con.execute(_ROWS))
    return [_unit_row(row, tasks, choices) for row in rows]


def _unit_row(row: Row, tasks: Tasks, choices: Mapping[tuple[Any, ...], list[Row]]) -> UnitRow:
    subject = subject_of(row)
    own_choices = choices.get((*words.unit_key(row), subject["component"]), [])
    return UnitRow(row | {"choices": own_choices}, tasks_of(tasks, subject))


def dates_line(con: duckdb.DuckDBPyConnection) -> str:
    """Write until when the data of a catalog go and which night made it; empty before the first flight."""
    ((until,),) = con.execute("select max(departed_at) from flights").fetchall()
    night = nights_of(con)[0][:16].replace("T", " ")
    return _("Flights until {until}; night of {night} UTC.", until=words.clock(until), night=night) if until else ""


def rows_of(home: Path) -> list[UnitRow]:
    """Read the rows of a home."""
    tasks = read_tasks(home)
    with connect_current(home) as con:
        return read_rows(con, tasks)


def silence_lines(units: Iterable[UnitRow]) -> list[str]:
    """Write a line that names the aircraft that send nothing; none where each does."""
    silent = {f"{unit['operator']} {unit['tail']}": unit["silent_since"] for unit in units if unit["silent_since"]}
    since = "; ".join(_("{tail} since {day}", tail=tail, day=words.day(day)) for tail, day in silent.items())
    return [_("No flight of {since}: look for the missing files.", since=since)] if since else []


def subject_of(row: Row) -> Row:
    """Return what a row's work is about: its most urgent alert or, without one, its component."""
    if row["alert_id"]:
        return {c: row[c] for c in ("diagnosis", "action_phrases", "units_in_90_days")} | {
            "component": row["alert_component"]
        }
    part = row["outlook_component"] or row["component"] or "HX"
    phrases = stored_action(components()[part].action) if part in words.DECLARED else ""
    return {"diagnosis": part, "component": part, "action_phrases": phrases, "units_in_90_days": None}
