"""Rows of the catalog that follow from lines of the log of cases written since the night.

The night's tables stay as they are. The catalog stores beside them the rows of each aircraft that such a line is about,
and its views read these instead, so that a closing counts in every output at once. The next night makes them itself.
"""

from collections.abc import Mapping

import duckdb
import polars as pl

from hdt_core.alerts.answers import alerts_now, log_now
from hdt_core.records.keys import AIRCRAFT
from hdt_core.tables import TABLES
from pipelines.storage.cases import CaseLog, with_ids

LIVE = ("raw_cases", "raw_maintenance", "features_alerts")
"""Tables that a line of the log changes at once."""


def prepare_since(con: duckdb.DuckDBPyConnection) -> None:
    """Create the tables of the rows since the night, empty."""
    _store(con, {table: TABLES[table].schema.create_empty() for table in LIVE}, "")


def create_live_view(con: duckdb.DuckDBPyConnection, table: str, select: str) -> str:
    """Create the view of a table's rows of the night, given by `select`; return the SQL of those and the rows since."""
    con.execute(f"create or replace view tables.{table}_of_night as {select}")
    return live_select(table)


def live_select(table: str) -> str:
    """Return the SQL of a table of `LIVE`: the rows since the night in place of the night's of the same aircraft."""
    is_replaced = "(operator, tail) in (select (operator, tail) from tables.raw_cases_since)"
    of_night = f"select * from tables.{table}_of_night where not ({is_replaced})"
    return f"{of_night} union all by name select * from tables.{table}_since"


def store_since(con: duckdb.DuckDBPyConnection, log: CaseLog) -> None:
    """Store the rows that follow from the lines since the night in a catalog, and the version of the log."""
    version = log.version()
    entries = log.entries()
    new_lines = entries.join(with_ids(_of_night(con, "raw_cases")), on="id", how="anti")
    cases = entries.join(new_lines, on=AIRCRAFT, how="semi", maintain_order="left")
    log_then, alerts_then = (
        _of_night(con, table).join(new_lines, on=AIRCRAFT, how="semi", maintain_order="left")
        for table in ("raw_maintenance", "features_alerts")
    )
    work = log_now(log_then, cases)
    rows = {"raw_cases": cases, "raw_maintenance": work, "features_alerts": alerts_now(alerts_then, log_then, work)}
    _store(con, rows, version)


def _store(con: duckdb.DuckDBPyConnection, rows: Mapping[str, pl.DataFrame], log_version: str) -> None:
    for table, frame in rows.items():
        con.register("frame", TABLES[table].schema.conform(frame).to_arrow())
        con.execute(f"create or replace table tables.{table}_since as select * from frame")
        con.unregister("frame")
    con.execute(f"create or replace macro tables.log_version() as '{log_version}'")


def _of_night(con: duckdb.DuckDBPyConnection, table: str) -> pl.DataFrame:
    return TABLES[table].schema.conform(con.sql(f"from tables.{table}_of_night").pl())
