"""Definitions and costs of hits, false alarms, early and late alerts, declared before the trial begins."""

from dataclasses import dataclass
from importlib import resources
from typing import Any

from hdt_core.loading import UserError, parse_toml

DEFAULT = (resources.files("hdt_trial") / "declaration.toml").read_text("utf-8")


MOST, MOST_DAYS = 1e12, 36_525
"""Largest number, and largest number of days, that a declaration may hold."""


class TrialError(UserError):
    """A trial cannot proceed; the message names the remedy."""


@dataclass(frozen=True, slots=True)
class Rule:
    """The operator's own alerts: a select over the catalog, or a file."""

    name: str
    sql: str | None
    file: str | None


@dataclass(frozen=True, slots=True)
class Cost:
    """Cost of each outcome, in one currency."""

    currency: str
    unscheduled_event: float
    scheduled_removal: float
    false_alarm: float
    too_early: float


@dataclass(frozen=True, slots=True)
class Minimum:
    """Smallest counts that may be published."""

    count: int
    flights: int
    aircraft: int


@dataclass(frozen=True, slots=True)
class Declaration:
    """A trial's definitions, named as in `declaration.toml`."""

    name: str
    days: int
    components: tuple[str, ...]
    confidence: float
    findings: tuple[str, ...]
    no_fault: tuple[str, ...]
    early_flights: int
    late_flights: int
    lapse_days: float
    horizon_flights: int
    minimum: Minimum
    cost: Cost
    rules: tuple[Rule, ...]


def read_declaration(text: str) -> Declaration:
    """Parse a declaration in TOML; missing keys take their defaults.

    Raises
    ------
    TrialError
        Invalid TOML, an unknown key or an invalid value.
    """
    try:
        entries = parse_toml(text)
    except ValueError as error:
        raise TrialError(f"the declaration is {error}") from None
    if not isinstance(entries.get("rule", {}), dict):
        raise TrialError("declare each rule in a table [rule.NAME]")
    rules = tuple(_rule(name, entry) for name, entry in entries.pop("rule", {}).items())
    default = parse_toml(DEFAULT)
    flat = _fill_defaults(default, entries, "")
    sections = {name: flat.pop(name) for name in ("event", "alert", "prognosis", "minimum", "cost")}
    declared = Declaration(
        **_tuples(flat | sections["event"] | sections["alert"] | sections["prognosis"]),
        minimum=Minimum(**sections["minimum"]),
        cost=Cost(**sections["cost"]),
        rules=rules,
    )
    _check(declared)
    return declared


def _fill_defaults(default: dict[str, Any], entries: dict[str, Any], where: str) -> dict[str, Any]:
    for name, value in entries.items():
        default_value = default.get(name)
        if default_value is None:
            raise TrialError(f"the declaration has no {where}{name}; valid keys: {', '.join(default)}")
        if not (_same_kind(value, default_value)):
            raise TrialError(
                f"{where}{name} in the declaration is {value!r}; expected a value such as {default_value!r}"
            )
    return {
        name: _fill_defaults(default_value, entries.get(name, {}), f"{name}.")
        if isinstance(default_value, dict)
        else entries.get(name, default_value)
        for name, default_value in default.items()
    }


def _same_kind(value: Any, default: Any) -> bool:
    if isinstance(default, int | float) and not isinstance(value, bool):
        return isinstance(value, int | (float if isinstance(default, float) else int)) and 0 <= value <= MOST
    if isinstance(default, list):
        return isinstance(value, list) and all(isinstance(v, str) for v in value)
    return isinstance(value, type(default))


def _tuples(entries: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in entries.items()}


def _rule(name: str, entry: Any) -> Rule:
    fields = entry if isinstance(entry, dict) else {}
    if len(fields) != 1 or set(fields) - {"sql", "file"} or not isinstance(next(iter(fields.values())), str):
        raise TrialError(f"rule.{name} needs either `sql` or `file`, a string")
    return Rule(name, fields.get("sql"), fields.get("file"))


def _check(d: Declaration) -> None:
    if not 0.5 <= d.confidence < 1.0:
        raise TrialError(f"confidence is {d.confidence:g}; it must lie between 0.5 and 1")
    if not 0 < d.late_flights < d.early_flights:
        raise TrialError(f"late_flights, {d.late_flights}, must lie between 0 and early_flights, {d.early_flights}")
    if max(d.days, d.lapse_days) > MOST_DAYS:
        raise TrialError(f"days and lapse_days must not exceed {MOST_DAYS:,}")
    if not (d.days and d.components and d.horizon_flights):
        raise TrialError("days, components and horizon_flights must not be empty or 0")
