"""SQL under test: the checks by name, and the rows of an answer."""

from importlib import resources
from pathlib import Path

import duckdb

from pipelines.storage.catalog import connect

FILES = sorted((resources.files("sql") / "checks").iterdir(), key=lambda f: f.name)
CHECKS = {f.name.removesuffix(".sql"): f.read_text() for f in FILES if f.name.endswith(".sql")}


def rows(con: duckdb.DuckDBPyConnection, sql: str) -> list[tuple]:
    return con.execute(sql).fetchall()


def query(home: Path, sql: str) -> list[tuple]:
    """Rows of an answer of a home's catalog."""
    with connect(home) as con:
        return rows(con, sql)
