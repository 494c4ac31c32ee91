"""The cookbook's answers: each query of `docs/cookbook.md` asked of the shared sample home.

    python tests/support/cookbook.py HOME

writes them anew; HOME is one after a night over LX-AAB and A9-BAC of `data_samples/`, as tests/conftest.py makes it.
"""

import datetime as dt
import re
import sys
from pathlib import Path

import duckdb

from pipelines.storage.catalog import connect

PAGE = Path(__file__).parents[2] / "docs/cookbook.md"
_RECIPE = re.compile(r"^```sql\n(.*?)^```\n\n(\|.*?\n)(?=\n|\Z)", re.MULTILINE | re.DOTALL)


def recipes(page: str) -> list[tuple[str, str]]:
    """Each query with the answer that the page gives."""
    return _RECIPE.findall(page)


def answer(con: duckdb.DuckDBPyConnection, sql: str) -> str:
    """The answer to a query as a table of the page."""
    result = con.sql(sql)
    rows = ([_format_cell(v) for v in row] for row in result.fetchall())
    lines = [result.columns, ["---"] * len(result.columns), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def answered(page: str, con: duckdb.DuckDBPyConnection) -> str:
    """The page with the answers of this catalog."""
    marked = re.sub(r"(^```sql\n.*?^```\n)(?!\n\|)", r"\1\n| |\n", page, flags=re.MULTILINE | re.DOTALL)
    return _RECIPE.sub(lambda m: f"```sql\n{m[1]}```\n\n{answer(con, m[1])}", marked)


def _format_cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, dt.datetime):
        return f"{value:%Y-%m-%d %H:%M}"
    return f"{value + 0.0:g}" if isinstance(value, float) else str(value)  # no minus before nothing


if __name__ == "__main__":
    with connect(Path(sys.argv[1])) as home:
        PAGE.write_text(answered(PAGE.read_text(encoding="utf-8"), home), encoding="utf-8")
