"""Read the state of a night that the next digest is compared with: alerts, prognoses, gaps, silence, refused files."""

from typing import Any

import duckdb

from pipelines.intake.faults import silent_columns
from pipelines.report.tasks import BEST_CHOICE, Tasks, work_text

State = dict[str, Any]
"""JSON: `until`, `alerts` and `closed` by id, `outlook` by unit, `gaps` and `silent` by name, `files` by path."""
EMPTY: State = {"until": None, "alerts": {}, "closed": {}, "outlook": {}, "gaps": {}, "silent": {}, "files": {}}
"""State before the first night."""

_UNTIL = "select strftime(max(departed_at) at time zone 'UTC', '%Y-%m-%d %H:%M') from flights"
_ALERTS = f"""
select
    a.alert_id, a.operator, a.tail, a.pack, a.component, a.diagnosis, a.severity, a.urgency,
    strftime(a.raised_at at time zone 'UTC', '%Y-%m-%d') as since,
    strftime(a.closed_at at time zone 'UTC', '%Y-%m-%d') as closed_on,
    a.recommended_action as action, a.evidence_now as evidence,
    a.now_rul_flights as rul_flights, a.now_rul_low as rul_low, a.now_rul_high as rul_high,
    a.now_p_event_50 as p_event_50, n.choice, p.place, o.outcome, o.work_orders
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
_PART = ("pack", "component")
_FILES = """
select file, any_value(operator) as operator, sum(n_rows)::bigint as n_rows,
    string_agg(distinct replace(reason, '_', ' '), ', ' order by replace(reason, '_', ' ')) as reasons
from quarantine where file is not null and scope <> 'note' group by file order by file
"""


def read_state(con: duckdb.DuckDBPyConnection, tasks: Tasks | None = None) -> State:
    """Read the state of a night from its catalog, with the work of each alert where `tasks` has it."""
    ((until,),) = con.execute(_UNTIL).fetchall()
    alerts = {
        row["alert_id"]: row | {"work": work_text(tasks or {}, row | {"recommended_action": row["action"]})}
        for row in _rows(con, _ALERTS)
    }
    return {
        "until": until,
        "alerts": {name: row for name, row in alerts.items() if row["closed_on"] is None},
        "closed": {name: row for name, row in alerts.items() if row["closed_on"] is not None},
        "outlook": {_key(r, "operator", "tail", "pack", "component"): r for r in _rows(con, _OUTLOOK)},
        "gaps": {
            _key(r, "operator", "tail", "gap", "since", "after_flight_id", *(_PART if r["pack"] else ())): r
            for r in _rows(con, _GAPS)
        },
        "silent": {
            _key(r, "operator", "tail", "folder", "column_name", "reason"): r for r in map(dict, silent_columns(con))
        },
        "files": {row["file"]: row for row in _rows(con, _FILES)},
    }


def _rows(con: duckdb.DuckDBPyConnection, sql: str) -> list[dict[str, Any]]:
    return list(con.sql(sql).pl().iter_rows(named=True))


def _key(row: dict[str, Any], *columns: str) -> str:
    return "|".join(str(row[c]) for c in columns)
