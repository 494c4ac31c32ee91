"""The catalog's views over tables of a few rows made by hand."""

import datetime as dt
from collections.abc import Sequence
from functools import cache

import duckdb
import polars as pl
from alert_texts import evidence_of, text_columns

from hdt_core.components import component_rows
from hdt_core.tables import TABLES
from pipelines.storage.catalog_views import list_diagnoses
from pipelines.storage.view_headers import views

START = dt.datetime(2024, 3, 1, 6, tzinfo=dt.UTC)
OWN = {"operator": "AAA", "tail": "T-1", "pack": 1}


def catalog(**tables: list[dict]) -> duckdb.DuckDBPyConnection:
    """The views over tables made of these rows; what is not named is null, tables not named are empty."""
    con = _empty_catalog().cursor()
    con.execute("set TimeZone = 'America/Lima'")
    con.begin()  # never committed: others find the tables empty
    fill(con, **{"components": component_rows()} | tables)
    return con


@cache
def _empty_catalog() -> duckdb.DuckDBPyConnection:
    """Views over tables without a row, half a second's work."""
    con = duckdb.connect()
    con.execute("create schema tables")
    list_diagnoses(con)
    for name, table in TABLES.items():
        arrow_table = table.schema.create_empty().to_arrow()  # noqa: F841
        con.execute(f"create table tables.{name} as select * from arrow_table")
    for sql in views().values():
        con.execute(sql)
    return con


def fill(con: duckdb.DuckDBPyConnection, **tables: Sequence[dict]) -> None:
    """Let tables hold these rows and no others."""
    for name, rows in tables.items():
        con.execute(f"delete from tables.{name}")
        if rows:
            frame = TABLES[name].schema.conform(pl.DataFrame(rows, infer_schema_length=None))
            arrow_table = frame.to_arrow()  # noqa: F841
            con.execute(f"insert into tables.{name} by name select * from arrow_table")


def flight(n: int, *, tail: str = "T-1", operator: str = "AAA") -> dict:
    """Flight n of a tail that flies once a day."""
    at = START + dt.timedelta(days=n)
    name = f"{tail}_{at:%Y%m%d}_01"
    times = {"departed_at": at, "landed_at": at + dt.timedelta(hours=2)}
    return {"operator": operator, "tail": tail, "flight_id": name} | times


def fouling(n: int, value: float, *, tail: str = "T-1", pack: int = 1) -> dict:
    estimate = {"pack": pack, "component": "HX", "parameter": "hx_fouling", "value": value, "sd": 0.01}
    return flight(n, tail=tail) | estimate | {"unit": "-", "status": "ok", "estimator": "made up"}


def replaced(n: int, finding: str | None = "FOULED", component: str = "HX") -> dict:
    done = {"done_on": (START + dt.timedelta(days=n)).date(), "component": component, "action": "REPLACED"}
    ends = START.replace(hour=0) + dt.timedelta(days=n + 1)
    return OWN | done | {"finding": finding, "reference": f"WO{n}", "counts_from": ends}


def chances(chance: float) -> dict:
    """The same chance of an event within any number of flights."""
    return dict.fromkeys((f"p_event_{n}" for n in (25, 50, 100, 200, 300)), chance)


def message(n: int, code: str = "21-52-HXTEMP") -> dict:
    at = START + dt.timedelta(days=n, hours=1)
    return OWN | {"message_time": at, "flight_id": flight(n)["flight_id"], "code": code}


def alert(name: str, n: int, closed: int | None = None, component: str = "HX") -> dict:
    at = START + dt.timedelta(days=n)
    texts = text_columns(evidence_of("e"), evidence_of("e"), "a")
    fields = {"diagnosis": "HX_FOULING", "severity": "medium"} | texts
    ends = None if closed is None else START + dt.timedelta(days=closed)
    times = {"raised_flight_id": flight(n)["flight_id"], "raised_at": at, "closed_at": ends}
    return OWN | fields | times | {"alert_id": name, "component": component}
