"""Fleets unlike the sample, files in wrong units, a flight that a stage fails at: each night ends sound and says so."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
from answers import query
from nights import keep_base, run
from polars.exceptions import PanicException
from soundness import faults
from zones import drop_fleet, simulated

import pipelines.assets.twin as twin_assets
from benchmarks.fault_points import fingerprint
from pipelines.cli.doctor import Check, examine
from pipelines.report.page import write_report
from pipelines.storage.catalog import connect
from pipelines.storage.store import Store

Deliveries = Iterator[None]
COMPRESSOR = ("cc_speed_rpm", "cc_in_degc", "cc_in_psia", "cc_out_degc", "cc_out_psia", "cc_flow_lbpm", "vda_pos")


def one_flight_and_nothing_else(landing: Path) -> Deliveries:
    simulated(6, 1, operator="ZZZ", tail="--").drop_csv(landing)
    yield


def an_empty_zone_then_papers_then_flights(landing: Path) -> Deliveries:
    zone = simulated(7, 60, operator="QQX", tail="0000000000")
    yield
    zone.drop_papers(landing)
    yield
    zone.only(zone.flights[:6]).drop_csv(landing)
    yield


def logs_alone(landing: Path) -> Deliveries:
    zone = simulated(8, 2, operator="QQX", tail="Z9", cpl=2)
    drop_fleet(landing, [zone])
    zone.drop_logs(landing)
    yield


def history_alone_in_other_types(landing: Path) -> Deliveries:
    zone = simulated(9, 25, operator="QQX", tail="9V-SMA", first_day="2023-12-28")
    plain = pl.col(pl.Float64).cast(pl.Float32), pl.col("pack").cast(pl.Int64)
    zone.snapshots = zone.snapshots.with_columns(*plain, report_time=pl.col("report_time").dt.to_string("iso"))
    zone.drop_history(landing)
    yield


def two_operators_one_tail_few_columns(landing: Path) -> Deliveries:
    """An aircraft that changed hands; one operator records no compressor, the other lost a sensor for good."""
    first = simulated(10, 8, operator="QQX", tail="Z9")
    second = simulated(11, 8, operator="QQY", tail="Z9", cpl=1)
    first.snapshots = first.snapshots.drop(*COMPRESSOR, "ram_out_degc", "phase_code", strict=False)
    second.snapshots = second.snapshots.with_columns(hx_out_degc=pl.lit(None, pl.Float64))
    drop_fleet(landing, [second])
    for zone in (first, second):
        zone.drop_csv(landing)
        zone.drop_logs(landing)
        yield


def copied_folder_that_flies_on(landing: Path) -> Deliveries:
    """An aircraft's flights are copied to its next operator, whom the fleet list lacks."""
    zone = simulated(23, 7, operator="QQY", tail="Z9")
    copied = zone.only(zone.flights[:-1])
    before = replace(copied, operator="QQX", fleet=zone.fleet.with_columns(operator=pl.lit("QQX")))
    drop_fleet(landing, [before])
    before.drop_csv(landing)
    copied.drop_csv(landing)
    yield
    zone.only(zone.flights[-1:]).drop_csv(landing)
    yield


def never_off_the_ground(landing: Path) -> Deliveries:
    zone = simulated(12, 4, operator="QQX", tail="Z9")
    still = {"altitude_ft": 0.0, "mach": 0.0, "pt_psia": 14.7}
    zone.snapshots = zone.snapshots.with_columns(**still, phase_code=pl.lit("GR"))
    zone.drop_csv(landing)
    yield


def one_snapshot_of_one_pack_a_flight(landing: Path) -> Deliveries:
    zone = simulated(13, 5, operator="QQX", tail="Z9")
    zone.snapshots = zone.snapshots.filter(pl.col("pack") == 2).unique("flight_id", keep="last", maintain_order=True)
    zone.drop_csv(landing)
    yield


def only_rubbish(landing: Path) -> Deliveries:
    zone = simulated(13, 2, operator="QQX", tail="Z9")
    zone.drop_csv(landing)
    for file in landing.glob("*/*/acms/*.csv"):
        file.write_bytes(b"\xff\xfe\x00 not a report")
    (landing / "fleet.csv").write_text("no,fleet,list\n1,2,3\n")
    yield


def out_of_order_and_corrected(landing: Path) -> Deliveries:
    """The newest first, then the oldest as history, then what lies between; at last a file says otherwise."""
    zone = simulated(14, 24, operator="QQX", tail="B-2", cpl=1, first_day="2024-02-26")
    drop_fleet(landing, [zone])
    flights = zone.flights
    zone.only(flights[16:]).drop_csv(landing)
    yield
    zone.only(flights[:9]).drop_history(landing)
    zone.drop_papers(landing)
    yield
    zone.only(flights[7:16]).drop_csv(landing)
    zone.drop_logs(landing)
    yield
    again = zone.only(flights[12:13])
    again.snapshots = again.snapshots.with_columns(pl.col("hx_out_degc") + 2.0)
    again.drop_csv(landing)
    yield


RAW = ("raw_snapshots", "raw_messages", "raw_maintenance", "raw_fleet", "raw_checks")

SCENARIOS = (
    one_flight_and_nothing_else,
    an_empty_zone_then_papers_then_flights,
    logs_alone,
    history_alone_in_other_types,
    two_operators_one_tail_few_columns,
    copied_folder_that_flies_on,
    never_off_the_ground,
    one_snapshot_of_one_pack_a_flight,
    only_rubbish,
    out_of_order_and_corrected,
)


@pytest.fixture
def folders(sample_home, tmp_path) -> tuple[Path, Path]:
    """A landing zone without a file, and a home that has seen none."""
    landing = tmp_path / "landing"
    home = tmp_path / "home"
    landing.mkdir()
    keep_base(sample_home, home)
    return landing, home


def run_soundly(landing: Path, home: Path) -> None:
    """A night in which nothing fails, and that leaves a sound home."""
    assert run(landing, home).failed == {}
    assert faults(home, landing) == []


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda f: f.__name__)
def test_unlike_fleet_ends_sound(scenario, folders, sample_home, tmp_path):
    landing, home = folders
    n_nights = 0
    for _ in scenario(landing):
        run_soundly(landing, home)
        n_nights += 1
    if n_nights > 1:
        clean = tmp_path / "clean"
        keep_base(sample_home, clean)
        run(landing, clean)
        assert fingerprint(home) == fingerprint(clean)


def test_broken_redelivery_removes_nothing(folders):
    landing, home = folders
    zone = simulated(15, 3, operator="QQX", tail="Z9")
    drop_fleet(landing, [zone])
    zone.drop_csv(landing)
    last = max(landing.glob("*/*/acms/*.csv"))
    messages, work = (zone.folder(landing) / f"{name}.csv" for name in ("messages", "maintenance"))
    messages.write_text(f"message_time,flight_id,pack,code,text\n2024-03-04T09:00:00Z,{last.stem},1,21-52-HXTEMP,\n")
    work.write_text("done_on,pack,component,action,finding,reference\n2024-03-05,1,HX,CLEANED,FOULED,\n")
    plan = landing / "checks.csv"
    plan.write_text("operator,tail,date,name\nQQX,Z9,2024-06-19,A03\nQQX,Z9,2024-09-02,A04\n")
    run(landing, home)
    whole = fingerprint(home)
    contents = {file: file.read_bytes() for file in (last, messages, work, plan, landing / "fleet.csv")}
    for broken in (slice(0), slice(40), None):
        for file, content in contents.items():
            file.write_bytes(b"\0" * 100 if broken is None else content[broken])
        run_soundly(landing, home)
        assert {t: fingerprint(home)[t] for t in RAW} == {t: whole[t] for t in RAW}
    for file, content in contents.items():
        file.write_bytes(content)
    run(landing, home)
    assert fingerprint(home) == whole
    plan.write_text("operator,tail,date,name\n")  # all are done
    run(landing, home)
    assert Store(home).read_table("raw_checks").height == 0


def test_report_needs_no_flight(folders, tmp_path):
    landing, home = folders
    run(landing, home)
    write_report(home, tmp_path / "report.html")
    assert "</html>" in (tmp_path / "report.html").read_text()


def check_wiring(home: Path) -> Check:
    return next(c for c in examine(None, home) if c.name == "units and wiring")


def test_sample_fleet_is_wired_well(sample_home):
    assert check_wiring(sample_home).well


def test_disagreeing_files_are_named(folders):
    """In the quarantine, and by the doctor."""
    landing, home = folders
    zones = [simulated(31 + k, 3, operator=o, tail=t) for k, (o, t) in enumerate([("QQX", "Z9"), ("QQY", "Z9")])]
    swapped, fahrenheit, _ = zones[0].flights
    one = pl.col("hx_in_degc")
    other = pl.col("hx_out_degc")
    wrong = pl.col("flight_id") == swapped
    warm = pl.col("flight_id") == fahrenheit
    zones[0].snapshots = zones[0].snapshots.with_columns(
        pl.when(wrong).then(other).otherwise(one).alias("hx_in_degc"),
        pl.when(wrong).then(one).otherwise(other).alias("hx_out_degc"),
        pl.when(warm).then(pl.col("tat_degc") * 1.8 + 32).otherwise("tat_degc").alias("tat_degc"),
    )
    zones[0].maintenance = pl.DataFrame(
        {"done_on": ["1900-01-01", "2024-03-05"], "pack": [1, 3], "component": ["HX", "HX"],
         "action": ["REPLACED", "REPLACED"], "finding": ["", ""], "reference": ["WO1", "WO2"]}
    )  # fmt: skip
    drop_fleet(landing, zones)
    for zone in zones:
        zone.drop_csv(landing)
    zones[0].drop_papers(landing)
    run_soundly(landing, home)
    entries = query(home, "select distinct file, reason, column_name from quarantine where scope != 'value'")
    assert set(entries) == {
        (f"QQX/Z9/acms/{swapped}.csv", "swapped_columns", "hx_in_degc, hx_out_degc"),
        (f"QQX/Z9/acms/{fahrenheit}.csv", "wrong_unit", "tat_degc"),
        ("QQX/Z9/maintenance.csv", "too_early", "done_on"),
        ("QQX/Z9/maintenance.csv", "bad_pack", "pack"),
        ("QQX/Z9", "tail_of_two_operators", None),
        ("QQY/Z9", "tail_of_two_operators", None),
    }
    check = check_wiring(home)
    assert not check.well
    assert f"QQX/Z9/acms/{swapped}.csv: hx_in_degc, hx_out_degc swapped columns" in check.message


FLIGHTS = 7
BROKEN = "breaks_declaration"


@pytest.fixture(scope="module")
def zone():
    return simulated(23, FLIGHTS, operator="QQX", tail="Z9")


@pytest.fixture
def seven(zone, folders):
    """A landing zone of seven flights, and a home that has seen none."""
    drop_fleet(folders[0], [zone])
    zone.drop_csv(folders[0])
    return folders


def stored_flights(home) -> set[str]:
    return {f for (f,) in query(home, "select distinct flight_id from tables.twin_flights")}


@pytest.mark.parametrize("error", [RuntimeError, PanicException])
def test_failing_flight_is_named(error, zone, seven, monkeypatch):
    landing, home = seven
    sick = zone.flights[4]
    real = twin_assets.estimate_flights

    def estimate(samples, dsm, *parts):
        if sick in samples["flight_id"]:
            raise error("matrix is singular")
        return real(samples, dsm, *parts)

    monkeypatch.setattr(twin_assets, "estimate_flights", estimate)
    night = run(landing, home)
    (reason,) = (why for where, why in night.failed.items() if where == "operational twins: QQX:Z9")
    assert reason.startswith(f"{sick} (QQX/Z9/acms/{sick}.csv): ")
    assert "matrix is singular" in reason
    assert stored_flights(home) == set(zone.flights) - {sick}
    again = run(landing, home)
    assert [why for where, why in again.failed.items() if where.startswith("operational")] == [reason]
    assert again.cells < 3 * FLIGHTS  # its own, and what follows from it


def test_infinite_result_is_set_aside(zone, seven, monkeypatch):
    landing, home = seven
    sick = zone.flights[2]
    real = twin_assets.estimate_flights

    def estimate(samples, dsm, *parts):
        odd = (pl.col("flight_id") == sick) & (pl.col("pack") == 2)
        infinite = pl.when(odd).then(float("inf")).otherwise("flows_apart_ln")
        return real(samples, dsm, *parts).with_columns(infinite.alias("flows_apart_ln"))

    monkeypatch.setattr(twin_assets, "estimate_flights", estimate)
    run_soundly(landing, home)
    with connect(home) as con:
        (row,) = con.sql("select * from quarantine").pl().filter(reason=BROKEN).rows(named=True)
        n = con.execute("select count(*) from tables.twin_flights").fetchone()[0]
    assert n == 2 * FLIGHTS - 1
    expected = {"file": f"QQX/Z9/acms/{sick}.csv", "flight_id": sick, "column_name": "flows_apart_ln",
                "scope": "result", "n_rows": 0, "operator": "QQX", "tail": "Z9"}  # fmt: skip
    assert {name: row[name] for name in expected} == expected
    assert "flows_apart_ln is infinite" in row["detail"]
    assert '"pack": 2' in row["content"]
    assert run(landing, home).idle
    monkeypatch.undo()
    file = landing / "QQX/Z9/acms" / f"{sick}.csv"
    shutil.copy(file, file.with_name(f"{sick} (1).csv"))  # the flight is made again
    assert run(landing, home).failed == {}
    assert (BROKEN,) not in query(home, "select reason from quarantine")


def test_copied_folder_counts_once(folders):
    """For the operator with more flights, on each night."""
    landing, home = folders
    flown_by = []
    for _ in copied_folder_that_flies_on(landing):
        run_soundly(landing, home)
        flown_by += query(home, "select operator, count(distinct flight_id) from tables.twin_flights group by 1")
    assert flown_by == [("QQX", 6), ("QQY", 7)]
    assert query(home, "select distinct operator, likely_cause from held_flights") == [("QQX", "operator_QQY")]
