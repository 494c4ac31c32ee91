"""Read the work of each action (minutes, people, tools, part, zone, task) and choose the one action of an alert."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from importlib import resources
from pathlib import Path
from typing import Any

from hdt_core.alerts.alerts import REPEAT_UNITS
from hdt_core.alerts.diagnoses import DIAGNOSES
from hdt_core.components import components
from hdt_core.loading import parse_toml
from pipelines.report import words
from pipelines.storage.objects import StoreError
from pipelines.storage.settings import read_values
from pipelines.words import _, several
from pipelines.words.evidence import action_text

NAME = "tasks.toml"
ACTIONS = {"inspect": "inspect", "wash": "wash", "replace": "replace", "defer": "nothing until then"}
"""Labels of what may be done at the next stop."""
BEST_CHOICE = """
    left join next_stop as n on a.operator = n.operator and a.tail = n.tail and a.pack = n.pack
    and a.component = n.component and n.place = 1"""
"""Joins the choice of least expected cost, `n.choice`, to alerts `a`."""
MOST = {"minutes": 10_000, "people": 100}
MAX_TEXT = 200


@dataclass(frozen=True, slots=True)
class Task:
    """Work of one action; None or an empty text where it is not declared."""

    minutes: int | None = None
    people: int | None = None
    tools: str = ""
    part: str = ""
    zone: str = ""
    task: str = ""

    def effort(self) -> str:
        """Format time and people: `120 min, 2 people`."""
        people = several("{n} person", "{n} people", self.people) if self.people else ""
        return ", ".join(filter(None, (_("{n} min", n=self.minutes) if self.minutes else "", people)))

    def parts(self) -> list[str]:
        """Format effort, task number, zone, part and tools, as far as they are declared."""
        task = _("task {number}", number=self.task) if self.minutes and self.task else self.task
        zone = _("zone {zone}", zone=self.zone) if self.zone else ""
        part = _("part: {part}", part=self.part) if self.part else ""
        tools = _("tools: {tools}", tools=self.tools) if self.tools else ""
        return list(filter(None, (self.effort(), task, zone, part, tools)))

    def text(self) -> str:
        """Format the parts in one line."""
        return "; ".join(self.parts())


Tasks = Mapping[tuple[str, str], Task]
"""Work by component or diagnosis, and action."""


def read_tasks(home: Path) -> Tasks:
    """Read the work of each action: the home's `tasks.toml` over this project's.

    Raises
    ------
    StoreError
        The file can't be read, is no TOML, or holds an unknown key or an invalid value.
    """
    shipped = parse_toml((resources.files("pipelines.report") / NAME).read_text(encoding="utf-8"))
    tasks = dict(_merged({}, shipped, NAME))
    names = sorted({*components(), *DIAGNOSES, *(d.component for d in DIAGNOSES.values())})
    return tasks | dict(_merged(tasks, read_values(home / NAME, names), home / NAME))


def tasks_of(tasks: Tasks, alert: Mapping[str, Any]) -> dict[str, Task]:
    """Return the work of each action that an alert's diagnosis, else its component, declares."""
    own = {a: tasks.get((alert["diagnosis"], a)) or tasks.get((alert["component"], a)) for a in ACTIONS}
    return {action: task for action, task in own.items() if task}


def action_of(alert: Mapping[str, Any], tasks: Mapping[str, Task]) -> str:
    """Return the one action of an alert: its `choice` of least expected cost where wear alone is the cause, else look.

    Where no cost is known it is the first action that `tasks` has, a wash before a replacement. Of a declared component
    those that `tasks` lacks do not count: to look is to do what its declaration says.
    """
    kind = DIAGNOSES.get(alert["diagnosis"])
    is_wear = kind is None or kind.is_wear  # a declared part wears
    if not is_wear or (alert["units_in_90_days"] or 0) >= REPEAT_UNITS:
        return "inspect"
    first = next((a for a in ("wash", "replace") if a in tasks), "inspect")
    return alert["choice"] if alert.get("choice") in choices_of(alert["component"], tasks) else first


def choices_of(component: str, tasks: Mapping[str, Task]) -> set[str]:
    """Return the actions that may be chosen: of a declared component those with work, and to defer."""
    return {*tasks, "defer"} if component in words.DECLARED else set(ACTIONS)


def describe_action(action: str, alert: Mapping[str, Any], until: str = "") -> str:
    """Format an action in less than fifteen words: the first clause of a recommendation where that is to look."""
    if action == "inspect" and alert["action_phrases"]:
        return _first_clause(action_text(alert["action_phrases"]))
    if action == "defer" and until:
        return _("Nothing until {until}", until=until)
    return _(ACTIONS[action]).capitalize()


def _first_clause(text: str) -> str:
    """Return a text up to its first parenthesis, semicolon or full stop."""
    for end in (" (", "; ", ". "):
        text = text.partition(end)[0]
    return text.removesuffix(".")


def work_text(tasks: Tasks, alert: Mapping[str, Any]) -> str:
    """Format an alert's action and its work: `Wash: 120 min, 2 people; task 21-52-00-100-801; zone 191/192`."""
    own = tasks_of(tasks, alert)
    action = action_of(alert, own)
    text = own[action].text() if action in own else ""
    name = describe_action(action, alert)
    return f"{name}: {text}" if text else name


def _merged(tasks: Tasks, own: Mapping[str, Any], file: Any) -> Iterator[tuple[tuple[str, str], Task]]:
    """Yield the work that a file declares, missing values taken from `tasks`."""
    for name, actions in own.items():
        if not isinstance(actions, dict):
            raise StoreError(f"{file}: {name} is no table of actions")
        for action, values in actions.items():
            if action not in ACTIONS or action == "defer" or not isinstance(values, dict):
                raise StoreError(f"{file}: {name}.{action} is no action; there are inspect, wash, replace")
            for key, value in values.items():
                if fault := _fault_of(key, value):
                    raise StoreError(f"{file}: {name}.{action}.{key} {fault}")
            part = DIAGNOSES[name].component if name in DIAGNOSES else name
            yield (name, action), replace(tasks.get((name, action)) or tasks.get((part, action)) or Task(), **values)


def _fault_of(key: str, value: Any) -> str | None:
    """Return what is wrong with a value of `Task`."""
    if key not in (names := [f.name for f in fields(Task)]):
        return f"means nothing; there are {', '.join(names)}"
    if key in MOST:
        sound = type(value) is int and 1 <= value <= MOST[key]
        return None if sound else f"is {value!r:.40} and ought to be a whole number from 1 to {MOST[key]}"
    sound = isinstance(value, str) and len(value) <= MAX_TEXT and value.isprintable()
    return None if sound else f"is {value!r:.40} and ought to be one line of up to {MAX_TEXT} characters"
