"""The catalog keeps the contract: views, columns, keys, an exact account, and it is readable while a run writes."""

import re
import subprocess
import sys
from pathlib import Path

import duckdb
import pytest

from pipelines.catalog import connect, ordered, publish, views

CONTRACT = (Path(__file__).parents[2] / "docs/catalog.md").read_text()


def contract() -> dict[str, list[str]]:
    """Columns each view must have, read from the contract's own table."""
    rows = re.findall(r"^\| `(\w+)` \| [^|]+ \| (.+) \|$", CONTRACT, flags=re.MULTILINE)
    columns = {}
    for view, text in rows:
        listed = re.sub(r"\([^)]*\)", "", text)
        columns[view] = re.findall(r"\b[a-z][a-z_0-9]*\b", " ".join(re.findall(r"`([^`]*)`", listed)))
    return columns


@pytest.fixture(scope="module")
def con(sample_home):
    with connect(sample_home) as con:
        yield con


@pytest.mark.parametrize("view", contract())
def test_contract_columns_are_there_and_filled(con, view):
    held = {c[0] for c in con.execute(f"describe {view}").fetchall()}
    assert set(contract()[view]) <= held
    if view not in {"alerts", "quarantine"}:
        assert con.execute(f"select count(*) from {view}").fetchone()[0] > 0


KEYS = {
    "flights": "operator, tail, flight_id",
    "legs": "operator, tail, flight_id, pack",
    "health_parameters": "operator, tail, flight_id, pack, parameter",
    "residuals": "operator, tail, flight_id, pack, signal, kind",
    "features": "operator, tail, flight_id, pack",
    "prognoses": "operator, tail, flight_id, pack, component",
    "alerts": "alert_id",
    "deliveries": "file",
}


@pytest.mark.parametrize("view", KEYS)
def test_keys_are_unique_and_never_null(con, view):
    key = KEYS[view]
    assert con.execute(f"select count(*) - count(distinct ({key})) from {view}").fetchone()[0] == 0
    nulls = " or ".join(f"{k} is null" for k in key.split(", "))
    assert con.execute(f"select count(*) from {view} where {nulls}").fetchone()[0] == 0


@pytest.mark.parametrize("view", contract())
def test_missing_is_null_and_never_nan(con, view):
    numbers = [c[0] for c in con.execute(f"describe {view}").fetchall() if c[1] in {"DOUBLE", "FLOAT"}]
    for column in numbers:
        assert con.execute(f'select count(*) from {view} where isnan("{column}")').fetchone()[0] == 0, column


def test_every_delivered_row_is_accounted_for(con):
    wrong = con.execute("select * from deliveries where delivered <> loaded + quarantined + duplicate").fetchall()
    assert wrong == []
    stored = con.execute(
        "select (select count(*) from tables.raw_snapshots) + (select count(*) from tables.raw_logs)"
    ).fetchone()
    loaded = con.execute(
        "select sum(loaded) from deliveries where file like '%/acms/%' or file like '%/cpl/%'"
    ).fetchone()
    assert stored == loaded


def test_health_parameters_hold_what_the_contract_names(con):
    held = {p for (p,) in con.execute("select distinct parameter from health_parameters").fetchall()}
    wanted = {"hx_fouling", "hx_h_hot_w_k", "hx_h_cold_w_k", "cc_effective_diameter_m", "cc_efficiency_loss"}
    assert wanted <= held
    silent = "select count(*) from health_parameters where value is null and status in ('', 'ok', 'converged')"
    assert con.execute(silent).fetchone()[0] == 0
    assert (
        con.execute("select count(*) from health_parameters where value is not null and sd is null").fetchone()[0] == 0
    )


def test_a_reader_keeps_reading_while_the_catalog_is_published(own_home):
    _, home = own_home
    reader = connect(home)
    before = reader.execute("select count(*) from flights").fetchone()
    publish(home)
    assert reader.execute("select count(*) from flights").fetchone() == before
    reader.close()
    other = (
        f"import duckdb; print(duckdb.connect({str(home / 'catalog.duckdb')!r}, read_only=True).sql('from flights'))"
    )
    done = subprocess.run([sys.executable, "-c", other], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_home_that_was_copied_reads_its_own_tables(sample_home, own_home):
    _, home = own_home
    for file in (home / "tables/raw_flights").rglob("*.parquet"):
        file.unlink()
    with connect(home) as con:
        assert con.execute("select count(*) from flights").fetchone() == (0,)
    with connect(sample_home) as con:
        assert con.execute("select count(*) from flights").fetchone()[0] > 0


def test_a_second_reader_of_one_process_answers_too(sample_home):
    """Connections of one process share one database, which the first has locked."""
    with connect(sample_home) as first, connect(sample_home) as second:
        assert (
            second.sql("select count(*) from flights").fetchall()
            == first.sql("select count(*) from flights").fetchall()
        )


def test_nobody_writes_through_the_catalog(sample_home):
    with connect(sample_home) as con, pytest.raises(duckdb.Error):
        con.execute("create table mine (x int)")


def test_views_come_after_what_they_read():
    order = [name for name, _ in ordered(views())]
    assert order.index("fleet_ranking") > max(order.index(v) for v in ("health_parameters", "prognoses", "alerts"))
