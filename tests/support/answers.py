"""SQL under test: the checks by name, and the rows of an answer."""

from importlib import resources

import duckdb

FILES = sorted((resources.files("sql") / "checks").iterdir(), key=lambda f: f.name)
CHECKS = {f.name.removesuffix(".sql"): f.read_text() for f in FILES if f.name.endswith(".sql")}


def rows(con: duckdb.DuckDBPyConnection, sql: str) -> list[tuple]:
    return con.execute(sql).fetchall()
