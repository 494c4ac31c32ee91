"""Compare two nights: alerts, prognoses outside their earlier interval, gaps, silent columns, refused files."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import duckdb

from hdt_core.prognosis.model import HORIZON
from pipelines.intake.faults import silent_columns
from pipelines.intake.held import held_flights
from pipelines.report.rows import read_rows, unit_key
from pipelines.report.tasks import BEST_CHOICE, Tasks, read_tasks, work_text
from pipelines.storage.catalog_checks import connect_current
from pipelines.storage.ledger import Ledger
from pipelines.storage.publication import connect_as_of

State = dict[str, Any]
"""JSON: `until`; `alerts`, `closed` by case; `units` (to work on, without an alert) and `outlook` by unit; `gaps`,
`silent`, `held` by name; others by path.
"""
EMPTY: State = {
    "until": None, "alerts": {}, "closed": {}, "units": {}, "outlook": {}, "gaps": {}, "silent": {}, "files": {},
    "notes": {}, "held": {},
}  # fmt: skip
"""State before the first night."""

_UNTIL = "select strftime(max(departed_at) at time zone 'UTC', '%Y-%m-%d %H:%M') from flights"
_ALERTS = f"""
select
    a.case_id, a.alert_id, a.operator, a.tail, a.pack, a.component, a.diagnosis, a.severity, a.urgency,
    strftime(a.raised_at at time zone 'UTC', '%Y-%m-%d') as since,
    a.closed_on::varchar as closed_on,
    a.recommended_action, a.action_phrases, a.units_in_90_days, a.evidence_now as evidence,
    a.now_rul_flights as rul_flights, a.now_rul_low as rul_low, a.now_rul_high as rul_high,
    a.now_p_event_50 as p_event_50, n.choice,
    strftime(a.now_came_at at time zone 'UTC', '%Y-%m-%d') as came_at, a.now_came_flights_ago as came_flights_ago,
    p.place, o.outcome, o.work_orders
from alert_states as a
left join alert_outcomes as o on a.alert_id = o.alert_id
left join open_alerts as p on a.alert_id = p.alert_id
{BEST_CHOICE}
order by a.alert_id
"""
_OUTLOOK = """
with lives as (select operator, tail, pack, component, max(life) as life from unit_lives group by all)
select
    p.operator, p.tail, p.pack, p.component, any_value(l.life) as life, count(*) as n_flights,
    round(arg_max(p.rul_low, p.departed_at), 1) as rul_low,
    round(arg_max(p.rul_flights, p.departed_at), 1) as rul_flights,
    round(arg_max(p.rul_high, p.departed_at), 1) as rul_high,
    round(arg_max(p.p_event_50, p.departed_at), 4) as p_event_50
from prognoses as p
left join lives as l
    on p.operator = l.operator and p.tail = l.tail and p.pack = l.pack and p.component = l.component
anti join open_messages as m
    on p.operator = m.operator and p.tail = m.tail and p.pack = m.pack and p.component = m.component and m.is_pressing
where p.rul_flights is not null and p.status <> 'prior_only'
group by all
order by all
"""
_GAPS = """
select
    operator, tail, gap, strftime(from_at at time zone 'UTC', '%Y-%m-%d') as since, after_flight_id,
    n_flights, round(silent_days, 1) as silent_days, null as pack, null as component
from data_gaps
union all by name
select
    operator, tail, 'unlogged_work' as gap, strftime(departed_at at time zone 'UTC', '%Y-%m-%d') as since,
    flight_id as after_flight_id, pack, component
from unlogged_work
order by all
"""
_WITHOUT_ALERT = """
select operator, tail, pack, component, urgency, place from unit_rows
where alert_id is null and urgency in ('act', 'plan')
order by all
"""
_PART = ("pack", "component")
_FILES = """
select file, any_value(operator) as operator, sum(n_rows)::bigint as n_rows,
    string_agg(distinct replace(reason, '_', ' '), ', ' order by replace(reason, '_', ' ')) as reasons
from quarantine where file is not null and (scope = 'note') = $notes group by file order by file
"""


def read_state(con: duckdb.DuckDBPyConnection, tasks: Tasks | None = None) -> State:
    """Read the state of a night from its catalog, with the work of each alert where `tasks` has it."""
    ((until,),) = con.execute(_UNTIL).fetchall()
    units = read_rows(con, tasks) if tasks is not None else []
    work = {unit["alert_id"] or unit.key: unit.work() for unit in units if unit.needs_work}
    alerts = {}
    for row in _rows(con, _ALERTS):
        text = work.get(row["alert_id"]) or work_text(tasks or {}, row)
        del row["action_phrases"]  # of no use to a receiver
        alerts[row["case_id"]] = row | {"work": text}
    without_alert = [row | {"work": work.get(unit_key(row), "")} for row in _rows(con, _WITHOUT_ALERT)]
    return {
        "until": until,
        "alerts": {name: row for name, row in alerts.items() if row["closed_on"] is None},
        "closed": {name: row for name, row in alerts.items() if row["closed_on"] is not None},
        "units": {_key(r, "operator", "tail", "pack", "component"): r for r in without_alert},
        "outlook": {_key(r, "operator", "tail", "pack", "component"): r for r in _rows(con, _OUTLOOK)},
        "gaps": {
            _key(r, "operator", "tail", "gap", "since", "after_flight_id", *(_PART if r["pack"] else ())): r
            for r in _rows(con, _GAPS)
        },
        "silent": {
            _key(r, "operator", "tail", "folder", "column_name", "reason"): r for r in map(dict, silent_columns(con))
        },
        "files": {row["file"]: row for row in _rows(con, _FILES, notes=False)},
        "notes": {row["file"]: row for row in _rows(con, _FILES, notes=True)},
        "held": {_key(r, "operator", "flight_id", "reason"): r for r in held_flights(con)},
    }


def _rows(con: duckdb.DuckDBPyConnection, sql: str, **values: bool) -> list[dict[str, Any]]:
    return list(con.sql(sql, params=values).pl().iter_rows(named=True))


def _key(row: dict[str, Any], *columns: str) -> str:
    return "|".join(str(row[c]) for c in columns)


Row = dict[str, Any]
_URGENCY, _SEVERITY = ("none", "plan", "act"), ("low", "medium", "high")
KINDS = ("new", "worse", "closed", "moved", "eased", "silent", "gap", "held", "refused", "noted")
"""Kinds of change, in the order of the digest."""


@dataclass(frozen=True, slots=True)
class Digest:
    """Changes between two nights.

    Attributes
    ----------
    since, until : str or None
        Last departure on record then and now (UTC); None where there was none.
    changes : dict of str to list of dict
        By kind, see `KINDS`; a kind without a change is absent. A row has `operator` and `tail` (both may be null for a
        file) and the columns of its kind; `was` is the row of the earlier state.
    """

    since: str | None
    until: str | None
    changes: dict[str, list[Row]]

    def of(self, operator: str | None) -> "Digest":
        """Return the changes of one operator; all with None."""
        if operator is None:
            return self
        own = {k: [r for r in rows if r["operator"] == operator] for k, rows in self.changes.items()}
        return replace(self, changes={k: rows for k, rows in own.items() if rows})


def changes_since(home: Path, night: str | None = None) -> Digest:
    """Return the changes since the last night at or before `night`; since the last but one without it.

    Raises
    ------
    StoreError
        There was no night by then, or it is no longer stored.
    """
    with connect_current(home) as con:
        now = read_state(con, read_tasks(home))
    nights = list(Ledger(home, read_only=True).snapshots())
    if night is None and len(nights) < 2:
        return compare(EMPTY, now)
    with connect_as_of(home, night or nights[-2]) as con:
        return compare(read_state(con), now)


def compare(before: State, now: State) -> Digest:
    """Return the changes between two states; an alert raised and closed in between does not appear."""
    pairs = [(before["alerts"][name], row) for name, row in now["alerts"].items() if name in before["alerts"]]
    notes_before: dict[str, Row] = before["notes"] if "notes" in before else now["notes"]  # an older version kept none
    changes = {
        "new": [
            *(row for name, row in now["alerts"].items() if name not in before["alerts"]),
            *_new_units(before, now),
        ],
        "worse": [row | {"was": was} for was, row in pairs if _weight(row) > _weight(was)],
        "closed": [_closing(was, now) for name, was in before["alerts"].items() if name not in now["alerts"]],
        "moved": list(_moved_outlooks(before["outlook"], now["outlook"])),
        "eased": [row | {"was": was} for was, row in pairs if _weight(row) < _weight(was)],
        "silent": [row for name, row in now["silent"].items() if name not in before["silent"]],
        "gap": [row for name, row in now["gaps"].items() if name not in before["gaps"]],
        "held": [row for name, row in now["held"].items() if name not in before.get("held", {})],
        "refused": [row for name, row in now["files"].items() if before["files"].get(name) != row],
        "noted": [row for name, row in now["notes"].items() if notes_before.get(name) != row],
    }
    in_order = {kind: sorted(rows, key=_order) for kind in KINDS if (rows := changes[kind])}
    return Digest(before["until"], now["until"], in_order)


def _new_units(before: State, now: State) -> Iterable[Row]:
    """Yield units that need work now though no alert is open, and did not the night before."""
    units_before: dict[str, Row] = before.get("units", {})  # an earlier version stored none
    alerted = {_key(row, "operator", "tail", "pack") for row in before["alerts"].values()}
    for name, row in now["units"].items():
        if name not in units_before and _key(row, "operator", "tail", "pack") not in alerted:
            yield row


def _weight(alert: Row) -> tuple[int, int]:
    return _URGENCY.index(alert["urgency"]), _SEVERITY.index(alert["severity"])


def _order(row: Row) -> tuple[Any, ...]:
    """Sort in the order of `open_alerts`, then by aircraft."""
    return (
        row.get("place") or float("inf"),
        *(str(row.get(c) or "") for c in ("operator", "tail", "pack", "file", "since")),
    )


def _closing(was: Row, now: State) -> Row:
    """Return a closed alert's row; an alert that is no longer stored was withdrawn."""
    row = now["closed"].get(was["case_id"], was | {"closed_on": None, "outcome": "withdrawn"})
    return dict(row) | {"was": was}


def _moved_outlooks(before: dict[str, Row], now: dict[str, Row]) -> Iterable[Row]:
    """Yield units whose prognosis, plus the flights since, lies outside the earlier 90 % interval."""
    for name, row in now.items():
        was = before.get(name)
        if was is None or was["life"] != row["life"]:
            continue
        n_flown = max(row["n_flights"] - was["n_flights"], 0)
        middle = min(row["rul_flights"] + n_flown, HORIZON)
        if middle < was["rul_low"] or (middle > was["rul_high"] and was["rul_high"] < HORIZON):
            yield row | {"was": was, "flown": n_flown}
