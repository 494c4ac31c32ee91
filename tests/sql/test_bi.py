"""What BI tools ask of a database when it is connected, asked as they ask it."""

import re
import subprocess
import sys
from pathlib import Path

import duckdb
import pytest

from pipelines.storage.catalog import CATALOG
from pipelines.storage.view_headers import views

OTHER = """
import sys, duckdb
with duckdb.connect(sys.argv[1], read_only=True) as con:
    print(con.sql("select count(*) from flights").fetchall()[0][0])
"""


@pytest.fixture
def opened(sample_home):
    with duckdb.connect(str(sample_home / CATALOG), config={"access_mode": "read_only"}) as con:
        yield con


def test_catalog_lists_views_as_tables(opened):
    assert {name for (name,) in opened.sql("show tables").fetchall()} == set(views())
    listed = opened.sql("select table_schema, table_name from information_schema.tables").fetchall()
    assert {schema for schema, _ in listed} == {"main", "tables"}
    assert {name for schema, name in listed if schema == "main"} == set(views())


def test_columns_have_type_with_meaning(opened):
    query = "select data_type, comment from duckdb_columns() where schema_name = 'main' and not internal"
    columns = opened.sql(query).fetchall()
    assert len(columns) > 300
    assert all(kind and comment for kind, comment in columns)


def test_start_here_is_table_of_page(opened):
    page = (Path(__file__).parents[2] / "docs/catalog.md").read_text(encoding="utf-8")
    table = re.findall(r"^\| ([a-z][^|]*\?) \| `(\w+)`", page, re.MULTILINE)
    assert len(table) == 6
    assert opened.sql("select question, view_name from start_here order by place").fetchall() == table
    assert {name for _, name in table} <= set(views())


def test_views_are_read_beside_another_reader(opened, sample_home):
    (flights,) = opened.sql("select count(*) from flights").fetchall()[0]
    run = [sys.executable, "-c", OTHER, str(sample_home / CATALOG)]
    beside = subprocess.run(run, capture_output=True, text=True, check=True)
    assert int(beside.stdout) == flights
    for name in views():
        opened.sql(f'select * from "main"."{name}" limit 1').fetchall()


def test_attached_catalog_finds_its_tables(sample_home, tmp_path):
    with duckdb.connect(str(tmp_path / "own.duckdb")) as con:
        con.execute(f"set variable tables_folder = '{sample_home}/tables/'")
        con.execute(f"attach '{sample_home / CATALOG}' as hdt (read_only)")
        assert con.sql("select count(*) from hdt.main.flights").fetchall()[0][0] > 0
