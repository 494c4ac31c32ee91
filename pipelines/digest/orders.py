"""Write open alerts as work orders: CSV and JSON for a maintenance system, and a page to print."""

import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import duckdb
import polars as pl

from pipelines.digest.render import PAGES
from pipelines.report import words
from pipelines.report.tasks import BEST_CHOICE, Task, Tasks, action_of, tasks_of
from pipelines.sharing import safe
from pipelines.storage.files import replacing

COLUMNS = ("reference", "operator", "tail", "pack", "component", "action", "due", "reason", "case_id", "alert_id")
WORK = tuple(f.name for f in fields(Task))

_ORDERS = f"""
select
    'HDT-' || a.case_id as reference, a.operator, a.tail, a.pack, a.component, a.diagnosis,
    a.recommended_action, n.choice, a.urgency, a.now_rul_flights as rul_flights, a.now_rul_low as rul_low,
    a.now_rul_high as rul_high, a.now_p_event_50 as p_event_50, a.raised_on, a.case_id, a.alert_id,
    case
        when d.status = 'ok' then d.due_low_on
        when d.status is null and a.urgency = 'act' then (r.last_departed_at at time zone 'UTC')::date + 1
    end as due
from open_alerts as a
inner join cases as c on a.alert_id = c.alert_id
left join due_dates as d
    on a.operator = d.operator and a.tail = d.tail and a.pack = d.pack and a.component = d.component
{BEST_CHOICE}
left join flight_rates as r on a.operator = r.operator and a.tail = r.tail
where c.state not in ('muted', 'answered')
order by a.place
"""


def work_orders(con: duckdb.DuckDBPyConnection, tasks: Tasks, operator: str | None = None) -> pl.DataFrame:
    """Return one order for each open alert that is neither muted nor answered, the most urgent first.

    `due` is the first day of `due_dates`: by then the message has been raised with a probability of 5 %. Without a
    prognosis it is the day after the last flight for an alert to act on now, else null: the next check.
    """
    rows = con.sql(_ORDERS).pl()
    rows = rows if operator is None else rows.filter(operator=operator)
    orders = [row | _texts(row, tasks) for row in rows.to_dicts()]
    schema = rows.schema | {"reason": pl.String, "action": pl.String} | dict.fromkeys(WORK, pl.String)
    schema |= dict.fromkeys(("minutes", "people"), pl.Int64)
    return pl.DataFrame(orders, schema=schema).select(*COLUMNS, *WORK)


def write_orders(orders: pl.DataFrame, folder: Path, until: str) -> None:
    """Write `orders.csv`, `orders.json` and `orders.html` into a folder."""
    rows = json.loads(orders.write_json())
    works = [Task(**{name: row[name] for name in WORK}).parts() for row in rows]
    page = PAGES.get_template("orders.html").render(orders=list(zip(rows, works, strict=True)), until=until)
    files = {"orders.csv": safe(orders).write_csv(), "orders.json": json.dumps(rows, indent=1), "orders.html": page}
    for name, text in files.items():
        with replacing(folder / name) as file:
            file.write_text(text, encoding="utf-8")


def _texts(row: dict[str, Any], tasks: Tasks) -> dict[str, Any]:
    """Return action, reason and the work of the one action."""
    own = tasks_of(tasks, row)
    work = asdict(own.get(action_of(row, own), Task()))
    return {"action": words.plain(row["recommended_action"]), "reason": _reason(row)} | work


def _reason(row: dict[str, Any]) -> str:
    outlook = f"; flights left {words.flights_left(row)}" if row["rul_flights"] is not None else ""
    return f"{words.diagnosis(row['diagnosis'])} since {row['raised_on']}{outlook}"
