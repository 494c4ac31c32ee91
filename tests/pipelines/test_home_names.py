"""A home lies in a folder of any name, or is refused in one line before anything is written."""

import os

import polars as pl
import pytest
from command import hdt
from nights import empty_home

from hdt_core.loading import UserError
from pipelines.definitions import from_environment
from pipelines.orchestration.runs import open_instance
from pipelines.storage.catalog import connect
from pipelines.storage.publication import publish
from pipelines.storage.store import FLEET, Store

USABLE = (
    "ops #1", "a: b", "é 100%", "a'b", 'a"b', " lead", "trail ", "a{b}c", "{0}", "~", "$HOME", "- x",
    "-x", "a&b;c", "x=1", "@x", "file:", "a|b", "%s", "]x", "&x", "!x", "😀",
)  # fmt: skip
REFUSED = (
    "100%25",
    "b\\c",
    "ops [AQX]",
    "ops[",
    "a*b",
    "a?b",
    "a\nb",
    "a\rb",
    "a\tb",
    "a\x01b",
    "a\x7fb",
    os.fsdecode(b"\xff"),
)


@pytest.mark.parametrize("name", USABLE)
def test_instance_lies_in_home(tmp_path, name):
    home = tmp_path / name / "home"

    with open_instance(home) as instance:
        assert not instance.telemetry_enabled
        assert instance.event_log_storage.path_for_shard("x") == str(home / "dagster/history/x.db")


@pytest.mark.parametrize("name", USABLE)
def test_rows_are_read_through_catalog(tmp_path, name):
    home = tmp_path / name / "home"
    empty_home(home)
    refused = {"operator": "AQX", "tail": None, "file": "x.csv", "reason": "unknown_file", "detail": "x"}
    store = Store(home)
    schema = store.read_table("raw_files_quarantine").schema
    store.replace("raw_files_quarantine", [FLEET], pl.DataFrame([refused], schema=schema))
    publish(home)

    with connect(home) as con:
        rows = con.execute("select file from tables.raw_files_quarantine").fetchall()
        columns = con.execute("describe tables.raw_files_quarantine").fetchall()

    assert rows == [("x.csv",)]
    assert [name for name, *_ in columns] == list(schema)


@pytest.mark.parametrize("name", REFUSED)
def test_refused_home_gets_one_line(tmp_path, name):
    (tmp_path / "fleet.csv").write_text("operator,tail,packs\n")
    home = tmp_path / name / "home"

    night = hdt("nightly", "--landing", tmp_path, "--home", home)

    assert night.returncode == 2
    assert len(night.stderr.splitlines()) == 1
    assert not home.parent.exists()


@pytest.mark.parametrize("name", REFUSED)
def test_page_of_dagster_refuses_home(tmp_path, monkeypatch, name):
    monkeypatch.setenv("HDT_HOME", str(tmp_path / name))

    with pytest.raises(UserError, match="a home's path has"):
        from_environment()
