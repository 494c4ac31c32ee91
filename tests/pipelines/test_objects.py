"""Tables in an object store: killed between objects and commit, looked at from the catalog, a whole night."""

import json
import os
import signal
import subprocess
import sys
from contextlib import suppress

import duckdb
import polars as pl
import pytest
from answers import query
from nights import run
from soundness import faults

from benchmarks.fault_points import OF_OBJECTS, fingerprint
from pipelines.report.page import write_report
from pipelines.sharing import access_scope, export
from pipelines.storage.catalog import connect
from pipelines.storage.ledger import Ledger
from pipelines.storage.objects import StoreError, bucket
from pipelines.storage.publication import publish
from pipelines.storage.store import FLEET, URL, Store
from pipelines.storage.view_headers import views

TABLE = "prognosis_model"
WRITE = "import sys, polars as pl; from pathlib import Path; from pipelines.storage.store import FLEET, Store;" + (
    f" Store(Path(sys.argv[1])).replace({TABLE!r}, [FLEET], pl.read_json(sys.argv[2].encode()))"
)


def write(store: Store, version: str) -> None:
    store.replace(TABLE, [FLEET], pl.DataFrame({"model_version": [version], "card": ["{}"], "model": [b"x"]}))


def version(store: Store) -> list[str]:
    return store.read_table(TABLE)["model_version"].to_list()


@pytest.mark.parametrize("point", OF_OBJECTS)
def test_killed_writer_leaves_no_mixture(s3_url, tmp_path, point):
    store = Store(tmp_path, s3_url)
    write(store, "old")
    row = json.dumps([{"model_version": "new", "card": "{}", "model": ""}])
    armed = f"from benchmarks.fault_points import arm; arm('{point}:1'); {WRITE}"
    command = [sys.executable, "-c", armed, str(tmp_path), row]
    died = subprocess.run(command, env=os.environ | {URL: s3_url}, check=False)
    assert died.returncode == -signal.SIGKILL
    assert version(store) == ["new" if point == "after_commit" else "old"]
    files = [key for key in store.place.sizes(TABLE) if key.endswith(".parquet")]
    assert len(files) == (1 if point == "before_write" else 2)


def test_catalog_keeps_to_its_hour(s3_url, tmp_path, monkeypatch):
    monkeypatch.setenv(URL, s3_url)
    store = Store(tmp_path)
    write(store, "1")
    publish(tmp_path)
    write(store, "2")
    for expected in ("1", "2"):
        assert query(tmp_path, f"select model_version from tables.{TABLE}") == [(expected,)]
        publish(tmp_path)


FORBIDDEN = (
    "select * from read_text('{url}/prognosis_model/_delta_log/00000000000000000000.json')",
    "select * from read_text('{url}/prognosis_model/../secret.txt')",
    "select * from read_parquet('{url}/prognosis_model/*.parquet')",
    "select * from read_parquet('s3://fleets/other/prognosis_model/fleet.0.parquet')",
    "select * from read_text('/etc/passwd')",
    "select * from read_text('http://127.0.0.1/')",
    "copy (select 1) to '{url}/prognosis_model/pwned.parquet'",
    "set enable_external_access = true",
)


def test_catalog_reaches_tables_alone(s3_url, tmp_path, monkeypatch):
    monkeypatch.setenv(URL, s3_url)
    write(Store(tmp_path), "1")
    publish(tmp_path)
    before = set(bucket(s3_url).sizes(""))
    with connect(tmp_path) as con:
        for sql in FORBIDDEN:
            with suppress(duckdb.Error):  # refused; what the window does not show is not found, or no rows
                assert con.execute(sql.format(url=s3_url)).fetchall() == []
        assert con.execute("select current_setting('enable_external_access')").fetchall() == [(False,)]
        assert con.execute(f"select model_version from tables.{TABLE}").fetchall() == [("1",)]
    assert set(bucket(s3_url).sizes("")) == before


def test_catalog_of_other_store_stays(s3_url, tmp_path, monkeypatch):
    """Whoever forgets the variable must not publish a catalog over no tables."""
    monkeypatch.setenv(URL, s3_url)
    publish(tmp_path)
    before = (tmp_path / "catalog.duckdb").read_bytes()
    for other in ("", f"{s3_url}x", str(tmp_path / "elsewhere")):
        monkeypatch.setenv(URL, other)
        with pytest.raises(StoreError, match="reads another store"):
            connect(tmp_path)
    assert (tmp_path / "catalog.duckdb").read_bytes() == before


def test_night_on_objects_equals_files(s3_url, sample_landing, sample_home, tmp_path, monkeypatch):
    base = Store(sample_home).read_table("prognosis_base")
    monkeypatch.setenv(URL, s3_url)
    home = tmp_path / "home"
    Store(home).replace("prognosis_base", [FLEET], base)
    Ledger(home).mark("prognosis_base", Ledger(sample_home).cells("prognosis_base"))
    assert not run(sample_landing, home).failed
    assert not (home / "tables").exists()
    assert faults(home, sample_landing) == []
    on_objects = fingerprint(home)
    write_report(home, tmp_path / "report.html")
    rows = export(home, tmp_path / "out", access_scope(home, None, None), "parquet")
    assert run(sample_landing, home).idle
    monkeypatch.delenv(URL)
    assert on_objects == fingerprint(sample_home)
    assert rows == {v: query(sample_home, f"select count(*) from {v}")[0][0] for v in rows}
    assert set(rows) == set(views())


def test_refusal_hides_the_key(s3_url, tmp_path, monkeypatch):
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "a-wrong-secret")
    with pytest.raises(StoreError, match="privileges") as error:
        Store(tmp_path, s3_url).read_table(TABLE)
    assert "\n" not in str(error.value)
    assert "a-wrong-secret" not in str(error.value)
