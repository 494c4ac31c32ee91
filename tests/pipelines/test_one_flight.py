"""One flight costs no other: what it makes fail is found by halves and named, what comes out wrong is set aside."""

import shutil

import polars as pl
import pytest
from nights import keep_base, run
from polars.exceptions import PanicException
from soundness import faults
from zones import drop_fleet, simulated

import pipelines.assets.twin as twin_assets
from pipelines.storage.catalog import connect

FLIGHTS, BROKEN = 7, "breaks_declaration"


@pytest.fixture(scope="module")
def zone():
    return simulated(23, FLIGHTS, operator="QQX", tail="Z9")


@pytest.fixture
def folders(zone, sample_home, tmp_path):
    """A landing zone of seven flights, and a home that has seen none."""
    landing, home = tmp_path / "landing", tmp_path / "home"
    drop_fleet(landing, [zone])
    zone.drop_csv(landing)
    keep_base(sample_home, home)
    return landing, home


def stored(home) -> set[str]:
    with connect(home) as con:
        return {f for (f,) in con.execute("select distinct flight_id from tables.twin_flights").fetchall()}


@pytest.mark.parametrize("error", [RuntimeError, PanicException])
def test_a_flight_that_makes_a_stage_fail_is_found_and_named(error, zone, folders, monkeypatch):
    landing, home = folders
    sick = zone.flights[4]
    real = twin_assets.estimate_flights

    def estimate(samples, dsm):
        if sick in samples["flight_id"]:
            raise error("matrix is singular")
        return real(samples, dsm)

    monkeypatch.setattr(twin_assets, "estimate_flights", estimate)
    night = run(landing, home)
    (reason,) = (why for where, why in night.failed.items() if where == "operational twins: QQX:Z9")
    assert reason.startswith(f"{sick} (QQX/Z9/acms/{sick}.csv): ")
    assert "matrix is singular" in reason
    assert stored(home) == set(zone.flights) - {sick}
    again = run(landing, home)
    assert [why for where, why in again.failed.items() if where.startswith("operational")] == [reason]
    assert again.cells < 3 * FLIGHTS  # its own, and what follows from it


def test_a_row_that_breaks_its_declaration_is_set_aside_and_the_others_are_stored(zone, folders, monkeypatch):
    landing, home = folders
    sick = zone.flights[2]
    real = twin_assets.estimate_flights

    def estimate(samples, dsm):
        odd = (pl.col("flight_id") == sick) & (pl.col("pack") == 2)
        return real(samples, dsm).with_columns(
            pl.when(odd).then(float("inf")).otherwise("flows_apart_ln").alias("flows_apart_ln")
        )

    monkeypatch.setattr(twin_assets, "estimate_flights", estimate)
    assert run(landing, home).failed == {}
    assert faults(home, landing) == []
    with connect(home) as con:
        (row,) = con.sql("select * from quarantine").pl().filter(reason=BROKEN).rows(named=True)
        n = con.execute("select count(*) from tables.twin_flights").fetchone()[0]
    assert n == 2 * FLIGHTS - 1
    assert (row["file"], row["flight_id"], row["column_name"]) == (f"QQX/Z9/acms/{sick}.csv", sick, "flows_apart_ln")
    assert "flows_apart_ln is infinite" in row["detail"]
    assert (row["scope"], row["n_rows"], row["operator"], row["tail"]) == ("result", 0, "QQX", "Z9")
    assert '"pack": 2' in row["content"]
    assert run(landing, home).idle
    monkeypatch.undo()
    file = landing / "QQX/Z9/acms" / f"{sick}.csv"
    shutil.copy(file, file.with_name(f"{sick} (1).csv"))  # the flight is made again
    assert run(landing, home).failed == {}
    with connect(home) as con:
        assert BROKEN not in con.sql("select reason from quarantine").pl()["reason"].to_list()
