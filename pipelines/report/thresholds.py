"""Count alerts, outcomes and lead at higher and lower limits, with the catalog's own views."""

import re
from pathlib import Path
from typing import Any

import duckdb

from hdt_core.alerts.alerts import Trial, trials
from pipelines.storage.catalog import connect
from pipelines.storage.publication import read_header, views
from pipelines.storage.settings import alert_limits

OUTCOME_VIEWS = ("alert_hit_rates", "alert_lead_times")
_COUNTS = """
    select
        coalesce(any_value(n_alerts), 0) as alerts,
        coalesce(any_value(n_right), 0) as confirmed,
        coalesce(any_value(n_judged - n_right), 0) as false,
        coalesce(any_value(n_open), 0) as open,
        (select median(lead_flights) from alert_lead_times where diagnosis = $1) as lead_flights,
        (select count(*) from alert_lead_times where lead_flights is null and component = any_value(o.component))
            as missed
    from alert_hit_rates as o where diagnosis = $1"""
Row = dict[str, Any]


def thresholds(home: Path) -> list[Row]:
    """Return one row a diagnosis and value of its limit.

    Columns `diagnosis, limit, value, in_service, alerts, confirmed, false, open`, `lead_flights` (median) and `missed`
    (messages of the component without an alert before them).
    """
    definitions = _view_definitions()
    with connect(home) as con:
        names = sorted({t for _, sql in definitions for t in re.findall(r"\btables\.(\w+)", sql)})
        tables = {t: con.sql(f"select * from tables.{t}").to_arrow_table() for t in names}
        inputs = ("features", "raw_maintenance")
        features, maintenance = (con.sql(f"select * from tables.{t}").pl() for t in inputs)
    with duckdb.connect() as copy:
        copy.execute("set TimeZone = 'UTC'; create schema tables")
        for name, rows in tables.items():
            _replace(copy, name, rows)
        for _, sql in definitions:
            copy.execute(sql)
        return [_outcome(copy, t) for t in trials(features, maintenance, alert_limits(home))]


def _outcome(con: duckdb.DuckDBPyConnection, t: Trial) -> Row:
    _replace(con, "features_alerts", t.alerts.to_arrow())
    (row,) = con.sql(_COUNTS, params=[t.diagnosis]).pl().to_dicts()
    return {"diagnosis": t.diagnosis, "limit": t.limit, "value": t.value, "in_service": t.in_service, **row}


def _view_definitions() -> list[tuple[str, str]]:
    """Return the outcome views and those they read, in order of dependence."""
    definitions, names, queue = views(), set[str](), list(OUTCOME_VIEWS)
    while queue:
        name = queue.pop()
        names.add(name)
        queue += set(read_header(definitions[name]).sources) & set(definitions) - names
    return [(name, sql) for name, sql in definitions.items() if name in names]


def _replace(con: duckdb.DuckDBPyConnection, name: str, rows: Any) -> None:
    con.register("frame", rows)
    con.execute(f"create or replace table tables.{name} as select * from frame")
    con.unregister("frame")
