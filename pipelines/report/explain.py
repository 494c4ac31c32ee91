"""One pack or one alert in words, from the catalog alone: what was true when it was raised, what is true now."""

import re
from pathlib import Path
from typing import Any

import duckdb

from pipelines.report import words
from pipelines.storage.catalog import connect, rows
from pipelines.words import ENGLISH, _, language

Row = dict[str, Any]
_PACK = re.compile(
    r"(?:(?P<operator>[a-z]{3})[\s/]+)?(?P<tail>[a-z0-9-]{2,10})"
    r"(?:[\s/]+(?:pack\s+)?(?P<pack>[1-4])(?:\s+\((?:left|right)\))?)?",
    re.IGNORECASE,
)


def explain(home: Path, asked: str) -> str | None:
    """What `asked` names, in words; None where it names nothing.

    A tail names its most urgent pack. `TAIL PACK` and `TAIL/PACK` name a pack, with the operator before it where the
    reader likes, as the night and the report print it. All else is an alert's id, or the start of it.

    Raises
    ------
    ValueError
        More than one alert begins with it.
    """
    with connect(home) as con:
        packs, units = (_ranked(con, asked, view) for view in ("fleet_ranking", "component_ranking"))
        if packs or units:
            told = [_pack_told(con, packs[0], packs[1:])] if packs else []
            return "\n\n".join([*told, *(_unit_told(con, unit) for unit in units)])
        named = asked.strip().lower()
        alerts = _rows(con, "select * from alert_states where $1 <> '' and starts_with(alert_id, $1)", named)
    if len(alerts) > 1:
        raise ValueError(f"{len(alerts)} alerts begin with {asked}; give more of the id")
    return "\n".join(_alert_told(alerts[0])) if alerts else None


def _rows(con: duckdb.DuckDBPyConnection, sql: str, *values: Any) -> list[Row]:
    return rows(con.execute(sql, list(values)))


def _ranked(con: duckdb.DuckDBPyConnection, asked: str, view: str) -> list[Row]:
    """Packs, or units of other components, that `asked` names, the most urgent first."""
    named = _PACK.fullmatch(asked.strip())
    if named is None:
        return []
    operator, tail, pack = (named[name] and named[name].upper() for name in ("operator", "tail", "pack"))
    wanted = "tail = $1 and operator = coalesce($2, operator) and pack = coalesce($3, pack)"
    return _rows(con, f"select * from {view} where {wanted} order by place", tail, operator, pack and int(pack))


def _unit_told(con: duckdb.DuckDBPyConnection, row: Row) -> str:
    """A unit of another component and its open alerts."""
    sql = "select * from alert_states where operator = $1 and tail = $2 and pack = $3 and component = $4"
    alerts = _rows(con, f"{sql} order by place_in_pack", row["operator"], row["tail"], row["pack"], row["component"])
    head = _(
        "{unit}: {urgency}. {lost} {loss}, flights left {left}, chance of a failure within 50 flights {chance}; after "
        "{flight}, {time}.",
        unit=f"{row['operator']} {words.unit_name(row)}",
        lost=_(row["lost"]),
        loss=words.share(row["loss"], row["loss_sd"]),
        **_last(row),
    )
    opened = [a for a in alerts if a["closed_at"] is None]
    return "\n".join([head, *words.unknown([row]), *(line for a in opened for line in ("", *_alert_told(a)))])


def _pack_told(con: duckdb.DuckDBPyConnection, row: Row, others: list[Row]) -> str:
    units = "select component from tables.components where recorded"
    sql = f"select * from alert_states where operator = $1 and tail = $2 and pack = $3 and component not in ({units})"
    alerts = _rows(con, f"{sql} order by place_in_pack", row["operator"], row["tail"], row["pack"])
    opened = [a for a in alerts if a["closed_at"] is None]
    lines = [_head(row), *words.unknown([row]), *(line for a in opened for line in ("", *_alert_told(a)))]
    if not opened:
        last = max(alerts, key=lambda a: a["closed_at"], default=None)
        lines.append(_("No alert is open.") + (f" {_before(last)}" if last else ""))
    return "\n".join([*lines, *(["", *map(_beside, others)] if others else [])])


def _before(last: Row) -> str:
    named = {"diagnosis": words.diagnosis(last["diagnosis"]), "day": words.day(last["closed_at"])}
    return _("The last, {diagnosis}, closed {day}: alert {id}.", id=last["alert_id"], **named)


def _last(row: Row) -> Row:
    """What is true of a pack or unit after its last flight."""
    return {
        "urgency": words.urgency(row),
        "left": words.flights_left(row),
        "chance": words.chance(row["p_event_50"]),
        "flight": row["last_flight_id"],
        "time": words.clock(row["last_departed_at"]),
    }


def _head(row: Row) -> str:
    return _(
        "{pack}: {urgency}. UA lost {loss}, flights left {left}, chance of a message within 50 flights {chance}; after "
        "{flight}, {time}.",
        pack=f"{row['operator']} {words.pack_name(row)}",
        loss=words.loss(row),
        **_last(row),
    )


def _beside(row: Row) -> str:
    said = words.diagnosis(row["diagnoses"]) if row["diagnoses"] else _("no open alert")
    return _("Also {pack}: {urgency}, {said}.", pack=words.pack_name(row), urgency=words.urgency(row), said=said)


def _alert_told(a: Row) -> list[str]:
    """The alert's name and state, both of its moments, and what to do."""
    ended = a["closed_at"] is not None
    state = _("closed {time}", time=words.clock(a["closed_at"])) if ended else words.urgency(a)
    same, severity, at_first = a["evidence"] == a["evidence_now"], a["severity"], a["raised_severity"]
    then = words.tidy(a["evidence"]) if same else words.finding(a["evidence"])
    now = _("as then.") if same else _numbers(a, "now") + words.tidy(a["evidence_now"])
    at_last = _("At its end") if ended else _("Now")
    return [
        _("{pack}: {diagnosis}, {state}. Alert {id}.", pack=f"{a['operator']} {words.pack_name(a)}", state=state,
          diagnosis=f"{words.diagnosis(a['diagnosis'])} ({a['diagnosis']})", id=a["alert_id"]),
        _("When raised ({time}, after {flight}, {severity}): {told}", time=words.clock(a["raised_at"]),
          flight=a["raised_flight_id"], severity=_(at_first), told=_numbers(a, "raised") + then),
        _("{moment} (after {flight}, {severity}): {told}", moment=at_last, flight=a["now_flight_id"],
          severity=_(severity), told=now),
        _("To do: {action}", action=words.plain(a["recommended_action"])),
    ]  # fmt: skip


def _numbers(a: Row, moment: str) -> str:
    """What the evidence does not say: what was expected."""
    told = words.alert_state(a, moment)[1:]
    small = language() == ENGLISH
    names = [f"{name[0].lower()}{name[1:]}" if small else name for name, _value in told]
    return "; ".join(f"{name} {value}" for name, (_name, value) in zip(names, told, strict=True)) + ". " if told else ""
