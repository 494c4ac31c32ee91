"""Fleets unlike the sample: other names, little data, odd columns, files piecemeal. Every night ends sound."""

from collections.abc import Callable, Iterator
from pathlib import Path

import polars as pl
import pytest
from nights import keep_base, run
from soundness import faults
from zones import drop_fleet, simulated

from benchmarks.fingerprint import fingerprint

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


RAW = ("raw_snapshots", "raw_messages", "raw_maintenance", "raw_fleet")

SCENARIOS = (
    one_flight_and_nothing_else,
    an_empty_zone_then_papers_then_flights,
    logs_alone,
    history_alone_in_other_types,
    two_operators_one_tail_few_columns,
    never_off_the_ground,
    one_snapshot_of_one_pack_a_flight,
    only_rubbish,
    out_of_order_and_corrected,
)


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda f: f.__name__)
def test_every_night_is_sound_and_ends_where_one_night_would(
    scenario: Callable[[Path], Deliveries], sample_home: Path, tmp_path: Path
):
    landing, home = tmp_path / "landing", tmp_path / "home"
    landing.mkdir()
    keep_base(sample_home, home)
    nights = 0
    for _ in scenario(landing):
        night, nights = run(landing, home), nights + 1
        assert night.failed == {}
        assert faults(home, landing) == []
    if nights > 1:
        clean = tmp_path / "clean"
        keep_base(sample_home, clean)
        run(landing, clean)
        assert fingerprint(home) == fingerprint(clean)


def test_a_file_that_comes_again_broken_takes_nothing_away(sample_home, tmp_path):
    landing, home = tmp_path / "landing", tmp_path / "home"
    zone = simulated(15, 3, operator="QQX", tail="Z9")
    drop_fleet(landing, [zone])
    zone.drop_csv(landing)
    last = max(landing.glob("*/*/acms/*.csv"))
    messages, work = (zone.folder(landing) / f"{name}.csv" for name in ("messages", "maintenance"))
    messages.write_text(f"message_time,flight_id,pack,code,text\n2024-03-04T09:00:00Z,{last.stem},1,21-52-HXTEMP,\n")
    work.write_text("done_on,pack,component,action,finding,reference\n2024-03-05,1,HX,CLEANED,FOULED,\n")
    keep_base(sample_home, home)
    run(landing, home)
    whole = fingerprint(home)
    contents = {file: file.read_bytes() for file in (last, messages, work, landing / "fleet.csv")}
    for broken in (slice(0), slice(40), None):
        for file, content in contents.items():
            file.write_bytes(b"\0" * 100 if broken is None else content[broken])
        assert run(landing, home).failed == {}
        assert faults(home, landing) == []
        assert {t: fingerprint(home)[t] for t in RAW} == {t: whole[t] for t in RAW}
    for file, content in contents.items():
        file.write_bytes(content)
    run(landing, home)
    assert fingerprint(home) == whole


def test_the_report_of_a_home_without_a_flight_is_a_page(sample_home, tmp_path):
    from pipelines.report.page import write_report

    landing, home = tmp_path / "landing", tmp_path / "home"
    landing.mkdir()
    keep_base(sample_home, home)
    run(landing, home)
    write_report(home, tmp_path / "report.html")
    assert "</html>" in (tmp_path / "report.html").read_text()
