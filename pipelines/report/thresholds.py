"""How alerts would have fared with a limit higher or lower: counts, outcomes and lead by the catalog's own views."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import duckdb

from hdt_core.alerts.threshold_study import Trial, trials
from pipelines.storage.catalog import connect
from pipelines.storage.headers import read_header
from pipelines.storage.publication import ordered, views
from pipelines.storage.settings import alert_limits

JUDGED_BY = ("alert_hit_rates", "alert_lead_times")
_ALERTS = ("features_alerts", "features_component_alerts")
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
    """One row a diagnosis and value of its limit.

    With `diagnosis, limit, value, in_service, alerts, confirmed, false, open`, `lead_flights` (median) and `missed`
    (messages of the component that no alert foretold).
    """
    needed = _needed()
    with connect(home) as con:
        names = sorted({t for _, sql in needed for t in re.findall(r"\btables\.(\w+)", sql)})
        held = {t: con.sql(f"select * from tables.{t}").to_arrow_table() for t in names}
        asked = ("features", "twin_health", "raw_maintenance")
        features, health, maintenance = (con.sql(f"select * from tables.{t}").pl() for t in asked)
    with duckdb.connect() as trial:
        trial.execute("set TimeZone = 'UTC'; create schema tables")
        for name, rows in held.items():
            _replace(trial, name, rows)
        _replace(trial, _ALERTS[1], held[_ALERTS[1]].slice(0, 0))
        for _, sql in needed:
            trial.execute(sql)
        return list(_told(trial, trials(features, health, maintenance, alert_limits(home))))


def _told(con: duckdb.DuckDBPyConnection, tried: Iterator[Trial]) -> Iterator[Row]:
    for t in tried:
        _replace(con, _ALERTS[0], t.alerts.to_arrow())
        (row,) = con.sql(_COUNTS, params=[t.diagnosis]).pl().to_dicts()
        yield {"diagnosis": t.diagnosis, "limit": t.limit, "value": t.value, "in_service": t.in_service, **row}


def _needed() -> list[tuple[str, str]]:
    """The views that judge, with those they read, in order."""
    known, wanted, left = views(), set[str](), list(JUDGED_BY)
    while left:
        name = left.pop()
        wanted.add(name)
        left += set(read_header(known[name]).reads) & set(known) - wanted
    return ordered({name: known[name] for name in wanted})


def _replace(con: duckdb.DuckDBPyConnection, name: str, rows: Any) -> None:
    con.register("given", rows)
    con.execute(f"create or replace table tables.{name} as select * from given")
    con.unregister("given")
