"""Explain one pack or one alert from the catalog: its evidence when raised, and now."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import duckdb

from hdt_core.loading import UserError
from pipelines.report import words
from pipelines.report.rows import UnitRow, read_rows
from pipelines.report.tasks import BEST_CHOICE, Tasks, read_tasks, work_text
from pipelines.storage.catalog import fetch_dicts
from pipelines.storage.catalog_checks import connect_current
from pipelines.storage.publication import publish_lines
from pipelines.words import ENGLISH, _, language
from pipelines.words.evidence import WITH_COLUMNS, action_text, evidence_text

Row = dict[str, Any]
_UNIT = "a.operator = $1 and a.tail = $2 and a.pack = $3 and a.component"
_NAMED = "a.alert_id in (select alert_id from alert_cases where $1 <> '' and starts_with(known_as, $1))"
_PACK = re.compile(
    r"(?:(?P<operator>[a-z]{3})[\s/]+)?(?P<tail>[a-z0-9-]{2,10}(?:\.\d+)?)"
    r"(?:[\s/]+(?:pack\s+)?(?P<pack>[1-4])(?:\s+\((?:left|right)\))?)?",
    re.IGNORECASE,
)


def explain(home: Path, name: str) -> str | None:
    """Explain the pack, unit or alert of this name; None where there is none.

    A tail names its most urgent pack. `TAIL PACK` and `TAIL/PACK` name a pack, optionally with the operator before it,
    as the night and the report print it. Any other text is an alert's id, or the start of it.

    Raises
    ------
    UserError
        More than one alert begins with it.
    """
    tasks = read_tasks(home)
    publish_lines(home)
    with connect_current(home) as con:
        units = _named_units(con, tasks, name)
        packs = [unit for unit in units if unit["component"] is None]
        if units:
            first = [_text(con, tasks, packs[0], packs[1:])] if packs else []
            others = [_text(con, tasks, unit) for unit in units if unit["component"]]
            return "\n\n".join([*first, *others])
        alerts = _alerts(con, tasks, _NAMED, name.strip().lower())
    if len(alerts) > 1:
        raise UserError(f"{len(alerts)} alerts begin with {name}; give more of the id")
    return "\n".join(_alert_lines(alerts[0])) if alerts else None


def _rows(con: duckdb.DuckDBPyConnection, sql: str, *values: Any) -> list[Row]:
    return fetch_dicts(con.execute(sql, list(values)))


def _alerts(con: duckdb.DuckDBPyConnection, tasks: Tasks, where: str, *values: Any) -> list[Row]:
    """Read alerts with their work, those of one pack the most urgent first."""
    sql = f"select a.*, n.choice from alert_states as a {BEST_CHOICE} where {where} order by a.place_in_pack"
    return [a | {"work": work_text(tasks, a)} for a in _rows(con, sql, *values)]


def _named_units(con: duckdb.DuckDBPyConnection, tasks: Tasks, name: str) -> list[UnitRow]:
    """Read the packs and units of other components of this name, the most urgent first."""
    match = _PACK.fullmatch(name.strip())
    if match is None:
        return []
    operator, tail, pack = (match[part] and match[part].upper() for part in ("operator", "tail", "pack"))
    named = "tail = $1 and operator = coalesce($2, operator)"
    sql = f"select present_operator, present_tail from tables.names where {named}"
    had = {(r["present_operator"], r["present_tail"]) for r in _rows(con, sql, tail, operator)}

    def is_named(unit: UnitRow) -> bool:
        is_aircraft = unit["tail"] == tail and operator in (None, unit["operator"])
        is_aircraft = is_aircraft or (unit["operator"], unit["tail"]) in had
        return is_aircraft and pack in (None, str(unit["pack"]))

    return [unit for unit in read_rows(con, tasks) if is_named(unit)]


def _text(con: duckdb.DuckDBPyConnection, tasks: Tasks, unit: UnitRow, others: Sequence[UnitRow] = ()) -> str:
    """Describe a pack, or a unit of another component, its open alerts, and in a line each the `others`."""
    if unit["component"]:
        alerts = _alerts(con, tasks, f"{_UNIT} = $4", *unit.key)
    else:
        units = "select component from tables.components where recorded"
        alerts = _alerts(con, tasks, f"{_UNIT} not in ({units})", *unit.key)
    opened = [a for a in alerts if a["closed_at"] is None]
    notes = [f"{note[:1].upper()}{note[1:]}." for note in unit.notes()]
    evidence = [line for a in opened for line in ("", *_alert_lines(a))]
    lines = [*_head(unit), *_reference(con, unit), *notes, *words.unknown([unit.values]), *evidence]
    if not opened:
        last = max(alerts, key=lambda a: a["closed_at"], default=None)
        lines.append(_("No alert is open.") + (f" {_before(last)}" if last else ""))
    return "\n".join([*lines, *(["", *map(_beside, others)] if others else [])])


def _before(last: Row) -> str:
    values = {"diagnosis": words.diagnosis(last["diagnosis"]), "day": words.day(last["closed_on"])}
    return _("The last, {diagnosis}, closed {day}: alert {id}.", id=last["alert_id"], **values)


def _head(unit: UnitRow) -> list[str]:
    """Write the state of a pack or unit after its last flight, and the one thing to do."""
    lost = unit["lost"] or words.WEARS["HX"][0]
    due = unit.due()
    state = _(
        "{unit}: {urgency}. {lost} {loss}; flights left {left}{due}; {outlook}. Data until {flight}, {time}.",
        unit=unit.name(),
        urgency=unit.urgency(),
        lost=_(lost),
        loss=unit.loss(),
        left=unit.flights_left(),
        due=f", {due}" if due else "",
        outlook=unit.message_phrase(),
        flight=unit["last_flight_id"],
        time=words.clock(unit["data_until"]),
    )
    work = unit.work(with_effort=not unit["alert_id"])  # an alert has it below, with tools and parts
    return [state, _("To do: {action}.", action=work)] if work else [state]


def _reference(con: duckdb.DuckDBPyConnection, unit: UnitRow) -> list[str]:
    """Write what became of other units at this loss."""
    part = unit["outlook_component"] or unit["component"]
    sql = "select * from reference_classes as a where " + f"{_UNIT} = $4"
    rows = _rows(con, sql, *unit.key[:3], part)
    text = words.reference(rows[0]) if rows else ""
    return [text] if text else []


def _beside(unit: UnitRow) -> str:
    alerts = unit.diagnosis() or _("no open alert")
    return _("Also {pack}: {urgency}, {alerts}.", pack=unit.name(), urgency=unit.urgency(), alerts=alerts)


def _alert_lines(a: Row) -> list[str]:
    """Describe an alert: its state, its evidence when raised and now, and what to do."""
    is_closed = a["closed_at"] is not None
    state = _("closed {time}", time=words.day(a["closed_on"])) if is_closed else words.urgency(a)
    same = a["evidence"] == a["evidence_now"]
    severity = a["severity"]
    at_first = a["raised_severity"]
    then = evidence_text(a["evidence_phrases"], WITH_COLUMNS, has_alternatives=same)
    now = _("unchanged.") if same else _numbers(a, "now") + evidence_text(a["evidence_now_phrases"], WITH_COLUMNS)
    at_last = _("At its end") if is_closed else _("Now")
    return [
        _("{pack}: {diagnosis}, {state}. Alert {id}.", pack=f"{a['operator']} {words.unit_name(a)}", state=state,
          diagnosis=f"{words.diagnosis(a['diagnosis'])} ({a['diagnosis']})", id=a["alert_id"]),
        _("When raised ({time}, after {flight}, {severity}): {evidence}", time=words.clock(a["raised_at"]),
          flight=a["raised_flight_id"], severity=_(at_first), evidence=_numbers(a, "raised") + then),
        _("{moment} (after {flight}, {severity}): {evidence}", moment=at_last, flight=a["now_flight_id"],
          severity=_(severity), evidence=now),
        _("Work: {work}", work=a["work"]),
        _("Recommended: {action}", action=action_text(a["action_phrases"])),
    ]  # fmt: skip


def _numbers(a: Row, moment: str) -> str:
    """Return the forecast of the component, which the evidence does not hold."""
    values = words.alert_state(a, moment)[1:]
    lower = language() == ENGLISH
    parts = [f"{name[:1].lower() + name[1:] if lower else name} {value}" for name, value in values]
    return "; ".join(parts) + ". " if parts else ""
