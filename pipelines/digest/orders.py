"""Write open alerts as work orders: CSV and JSON for a maintenance system, and a page to print."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields
from datetime import date, timedelta
from pathlib import Path
from typing import Any, cast

import duckdb
import polars as pl

from pipelines.digest.render import PAGES
from pipelines.report import words
from pipelines.report.rows import UnitRow, read_rows
from pipelines.report.tasks import Task, Tasks, action_of, describe_action, tasks_of
from pipelines.sharing import safe
from pipelines.storage.catalog import fetch_dicts
from pipelines.storage.files import replacing

COLUMNS = ("reference", "operator", "tail", "pack", "component", "action", "due", "reason", "case_id", "alert_id")
WORK = tuple(f.name for f in fields(Task))
Row = dict[str, Any]

_ALERTS = """
    select a.*, a.raised_on::varchar as since
    from open_alerts as a inner join cases as c on a.alert_id = c.alert_id
    where c.state <> 'muted' order by a.place"""


def work_orders(con: duckdb.DuckDBPyConnection, tasks: Tasks, operator: str | None = None) -> pl.DataFrame:
    """Return one order for each open alert that is not muted and each unit that needs work without one.

    The most urgent come first. `due` is the first day of `due_dates`: by then the message has been raised with a
    probability of 5 %. Without a prognosis it is the day after the last flight for an alert to act on now, else null:
    the next check.
    """
    alerts = fetch_dicts(con.execute(_ALERTS))
    units = [unit for unit in read_rows(con, tasks) if unit.needs_work and operator in (None, unit["operator"])]
    orders = [order for unit in units for order in _orders_of(unit, alerts, tasks)]
    schema = dict.fromkeys((*COLUMNS, *WORK), pl.String) | {"pack": pl.Int32, "due": pl.Date}
    schema |= dict.fromkeys(("minutes", "people"), pl.Int64)
    return pl.DataFrame(orders, schema=schema, orient="row")


def _orders_of(unit: UnitRow, alerts: list[Row], tasks: Tasks) -> Iterator[Row]:
    """Yield the orders of a unit, that of its most urgent alert first."""
    if unit["alert_id"] is None:
        name = "-".join(map(str, unit.key))
        yield _order(unit, f"HDT-{name}", unit.values) | _work(unit.action(), unit.to_do(), unit.tasks)
    for alert in filter(unit.owns, alerts):
        own_tasks = tasks_of(tasks, alert)
        action = unit.action() if alert["alert_id"] == unit["alert_id"] else action_of(alert, own_tasks)
        text = describe_action(action, alert, unit.until())
        yield _order(unit, f"HDT-{alert['case_id']}", alert) | _work(action, text, own_tasks)


def _order(unit: UnitRow, reference: str, subject: Row) -> Row:
    """Return an order without its work; `subject` is an alert, or the values of a unit without one."""
    component = subject["component"] or unit["outlook_component"]
    is_forecast = component == unit["outlook_component"]
    label = words.diagnosis(subject["diagnosis"]) if subject["diagnosis"] else ""
    cause = f"{label} since {subject['since']}" if label else "no alert"
    outlook = [f"{unit.loss()} lost", f"flights left {unit.flights_left()}", unit.message_phrase(), unit.cost()]
    reason = "; ".join(filter(None, [cause, *(outlook if is_forecast else ()), *unit.notes()]))
    place = {c: unit[c] for c in ("operator", "tail", "pack")} | {"component": component}
    due = {"due": _due(unit, is_forecast), "reason": reason}
    return {"reference": reference} | place | due | {c: subject[c] for c in ("case_id", "alert_id")}


def _due(unit: UnitRow, is_forecast: bool) -> date | None:
    if is_forecast and unit["due_status"] == "ok":
        return cast("date", unit["due_low_on"])
    is_undated = unit["due_status"] is None or not is_forecast
    return unit["data_until"].date() + timedelta(days=1) if is_undated and unit["urgency"] == "act" else None


def _work(action: str, text: str, tasks: Mapping[str, Task]) -> Row:
    return {"action": text} | asdict(tasks.get(action, Task()))


def write_orders(orders: pl.DataFrame, folder: Path, until: str) -> None:
    """Write `orders.csv`, `orders.json` and `orders.html` into a folder."""
    rows = json.loads(orders.write_json())
    works = [Task(**{name: row[name] for name in WORK}).parts() for row in rows]
    page = PAGES.get_template("orders.html").render(orders=list(zip(rows, works, strict=True)), until=until)
    files = {"orders.csv": safe(orders).write_csv(), "orders.json": json.dumps(rows, indent=1), "orders.html": page}
    for name, text in files.items():
        with replacing(folder / name) as file:
            file.write_text(text, encoding="utf-8")
