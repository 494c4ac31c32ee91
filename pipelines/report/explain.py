"""One pack or one alert in words, from the catalog alone: what was true when it was raised, what is true now."""

import re
from pathlib import Path
from typing import Any

import duckdb

from pipelines.report import words
from pipelines.storage.catalog import connect

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
    found = con.execute(sql, list(values))
    names = [c[0] for c in found.description or ()]
    return [dict(zip(names, row, strict=True)) for row in found.fetchall()]


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
    head = (
        f"{row['operator']} {words.unit_name(row)}: {words.URGENCY[row['urgency']]}. "
        f"{row['lost']} {words.with_sd(row['loss'], row['loss_sd'])}, flights left {words.flights_left(row)}, chance "
        f"of a failure within 50 flights {words.chance(row['p_event_50'])}; after {row['last_flight_id']}, "
        f"{words.clock(row['last_departed_at'])}."
    )
    opened = [a for a in alerts if a["closed_at"] is None]
    return "\n".join([head, *(line for a in opened for line in ("", *_alert_told(a)))])


def _pack_told(con: duckdb.DuckDBPyConnection, row: Row, others: list[Row]) -> str:
    units = "select component from tables.components where recorded"
    sql = f"select * from alert_states where operator = $1 and tail = $2 and pack = $3 and component not in ({units})"
    alerts = _rows(con, f"{sql} order by place_in_pack", row["operator"], row["tail"], row["pack"])
    opened = [a for a in alerts if a["closed_at"] is None]
    lines = [_head(row), *(line for a in opened for line in ("", *_alert_told(a)))]
    if not opened:
        last = max(alerts, key=lambda a: a["closed_at"], default=None)
        before = (
            f" The last, {words.diagnosis(last['diagnosis'])}, closed {words.day(last['closed_at'])}" if last else ""
        )
        lines.append("No alert is open." + (f"{before}: alert {last['alert_id']}." if last else ""))
    return "\n".join([*lines, *(["", *map(_beside, others)] if others else [])])


def _head(row: Row) -> str:
    left, chance = words.flights_left(row), words.chance(row["p_event_50"])
    return (
        f"{row['operator']} {words.pack_name(row)}: {words.URGENCY[row['urgency']]}. UA lost {words.loss(row)}, "
        f"flights left {left}, chance of a message within 50 flights {chance}; "
        f"after {row['last_flight_id']}, {words.clock(row['last_departed_at'])}."
    )


def _beside(row: Row) -> str:
    said = words.diagnosis(row["diagnoses"]) if row["diagnoses"] else "no open alert"
    return f"Also {words.pack_name(row)}: {words.URGENCY[row['urgency']]}, {said}."


def _alert_told(a: Row) -> list[str]:
    """The alert's name and state, both of its moments, and what to do."""
    state = words.URGENCY[a["urgency"]] if a["closed_at"] is None else f"closed {words.clock(a['closed_at'])}"
    now = "Now" if a["closed_at"] is None else "At its end"
    same = a["evidence"] == a["evidence_now"]
    return [
        f"{a['operator']} {words.pack_name(a)}: {words.diagnosis(a['diagnosis'])} ({a['diagnosis']}), {state}. "
        f"Alert {a['alert_id']}.",
        f"When raised ({words.clock(a['raised_at'])}, after {a['raised_flight_id']}, {a['raised_severity']}): "
        f"{_numbers(a, 'raised')}{words.tidy(a['evidence']) if same else words.finding(a['evidence'])}",
        f"{now} (after {a['now_flight_id']}, {a['severity']}): "
        + ("as then." if same else _numbers(a, "now") + words.tidy(a["evidence_now"])),
        f"To do: {a['recommended_action']}",
    ]


def _numbers(a: Row, moment: str) -> str:
    """What the evidence does not say: what was expected."""
    told = words.alert_state(a, moment)[1:]
    return "; ".join(f"{name[0].lower()}{name[1:]} {value}" for name, value in told) + ". " if told else ""
