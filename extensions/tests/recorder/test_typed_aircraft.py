"""Aircraft whose recorders are not the contract's: from the recorder's bytes to the catalog, by a description alone.

A small fleet of our own in ARINC 767 and 717 files; and the real recordings, which are not ours to ship, where they
are.
"""

import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from nights import run
from recordings import message_file, printed_report

from hdt_core.components import components
from hdt_core.flight.component_legs import component_samples
from hdt_core.simulate.design import FleetSettings
from hdt_core.simulate.fleet import simulate_fleet
from hdt_core.tracking.component_readings import component_readings
from hdt_recorder.recorder_rows import recorder_rows
from pipelines.cli.doctor import examine
from pipelines.intake.landing import list_landing
from pipelines.intake.simulated import write_fleet
from pipelines.lineage import STAGE
from pipelines.storage.catalog import connect
from pipelines.storage.ledger import Ledger
from pipelines.versions import find_stale_cells

ROOT = Path(__file__).parents[3]
REFERENCE = Path(os.environ.get("HDT_REFERENCE", ROOT.parent / "shared/reference")) / "recorder_787_a330"
SIZE = {"operators": 1, "tails": 1, "flights": 2, "cpl_share": 1.0}


def ask(home: Path, sql: str) -> list[tuple[Any, ...]]:
    with connect(home) as con:
        return con.sql(sql).fetchall()


def write(folder: Path, suite: str, form: str) -> tuple[Path, pl.DataFrame]:
    """A landing zone of recorder files, and the rows of its first flight as simulated."""
    size = FleetSettings(suite=suite, **SIZE)
    list(write_fleet(folder, 3, size, form))
    return folder / "landing", next(iter(next(simulate_fleet(3, size)).cpl.values()))


@pytest.mark.parametrize(("suite", "form"), [("787", "767"), ("787", "717")])
def test_recording_equals_simulation(tmp_path, suite, form):
    landing, true = write(tmp_path, suite, form)
    file = next(f for f in list_landing(landing).files if f.is_recording)
    rows, n_rows, faults = recorder_rows(file, "pack")
    columns = ["altitude_ft", "mach", "tat_degc", "hx_in_degc", "hx_out_degc", "ram_door_pct", "pack_flow_lbpm"]
    rows = rows.with_columns(pl.col("pack").cast(pl.Int32))
    joined = true.join(rows, on=["flight_id", "report_time", "pack"], suffix="_read")
    assert (n_rows, faults) == (rows.height, [])
    assert true.height - 8 <= joined.height <= true.height  # ARINC 717 writes whole frames of four seconds
    off = joined.select((pl.col(c) - pl.col(f"{c}_read")).abs().max() for c in columns)
    assert max(off.row(0)) < 1e-9
    assert joined.select((pl.col("pt_psia") / pl.col("pt_psia_read") - 1.0).abs().max()).item() < 1e-5


@pytest.fixture(scope="module")
def query(world) -> Callable[[str], list[tuple[Any, ...]]]:
    return partial(ask, world["home"])


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> dict[str, Any]:
    """A 787 and an A330 in one zone; a damaged recording, one of another map, a description with an error."""
    top = tmp_path_factory.mktemp("typed")
    landing, _ = write(top / "a", "787", "767")
    other, flown = write(top / "b", "A330", "717")
    shutil.move(other / "SAA", landing / "SAB")
    shutil.copytree(other / "types", landing / "types", dirs_exist_ok=True)
    lines = (other / "fleet.csv").read_text().splitlines()
    with (landing / "fleet.csv").open("a") as fleet:
        fleet.write(lines[1].replace("SAA", "SAB") + "\n")
    first, second = sorted((landing / "SAA/AA-0000/recorder").iterdir())
    data = bytearray(first.read_bytes())
    data[20_000:20_400] = bytes(400)
    first.write_bytes(data)
    stranger = landing / "SAB/AA-0000/recorder" / second.name.replace("_0", "_9")
    shutil.copy(second, stranger)
    (landing / "types/slip.toml").write_text('type = "SLIP"\nmap = "m.toml"\n[pack]\nmahc = "M"\n')
    cruise = flown.filter(pl.col("altitude_ft") == pl.col("altitude_ft").max())
    crossfed = {"flight": cruise["flight_id"][0], "at": cruise["report_time"][0]}
    (landing / "SAB/AA-0000/reports").mkdir()
    report = printed_report("AA-0000", crossfed["at"], 35_000, "1.20 111 11 1 00 111 1.20")
    reports = message_file(report, report.replace("AA-0000", "AA-0001"))
    (landing / "SAB/AA-0000/reports/message.dat").write_bytes(reports)
    night = run(landing, top / "home")
    assert not night.failed, night.failed
    return {"landing": landing, "home": top / "home", "damaged": first.name, "stranger": stranger.name} | crossfed


def test_both_types_reach_catalog(query):
    counts = query("select operator, source, count(*) from flights group by all order by all")
    assert counts == [("SAA", "cpl", 2), ("SAB", "component", 2)]


def test_health_of_types_has_status(query):
    health = query("select distinct operator, parameter, status from health_parameters order by all")
    assert set(health) >= {
        ("SAA", "hxt_effectiveness", "measured"),
        ("SAA", "cac_efficiency_seen", "measured"),
        ("SAB", "hxt_effectiveness_fast", "measured"),
        ("SAA", "cc_efficiency_loss", "not_recorded"),
    }
    assert {s for _, p, s in health if p in {"hxt_loss", "cac_efficiency_loss"}} == {"prior_only"}
    assert query("select distinct status from health_parameters anti join statuses using (status)") == []


def test_two_flights_calibrate_nothing(query):
    design = query("select distinct component, n_flights, identifiable from design_parameters "
                   "where component in ('HXT', 'CAC') order by all")  # fmt: skip
    assert design == [("CAC", 0, False), ("HXT", 0, False)]
    ((low, high),) = query("select min(sd), max(sd) from health_parameters where status = 'prior_only'")
    assert 0.02 < low <= high <= 0.15
    assert query("select count(*) from alerts where component in ('HXT', 'CAC')") == [(0,)]


def test_quarantine_names_each_fault(world, query):
    """Damage, a map that does not fit and a bad type."""
    rows = query("select file, reason, detail from quarantine")
    reasons = {(Path(file).name, reason): detail for file, reason, detail in rows}
    assert "frames: " in reasons[world["damaged"], "recording_damaged"]
    assert "no ARINC 717 frame" in (detail := reasons[world["stranger"], "map_does_not_fit"]) or "ARINC 767" in detail
    assert "[pack] mahc: no such column; mach is near" in reasons["slip.toml", "bad_type"]


def test_unfitting_recording_makes_no_leg(world, query):
    assert (world["stranger"].removesuffix(".dat"),) not in query("select distinct flight_id from component_legs")


def test_odd_bleed_turns_flight_away(world, query):
    """By a printed report."""
    legs = query("select distinct flight_id, reason from component_legs where operator = 'SAB' "
                 "and reason in ('', 'BLEED', 'NOT_COMMISSIONED') order by all")  # fmt: skip
    assert {reason for flight, reason in legs if flight == world["flight"]} == {"BLEED"}
    assert {reason for flight, reason in legs if flight != world["flight"]} == {"NOT_COMMISSIONED"}


def test_printed_report_reaches_catalog(world, query):
    (report,) = query("select report, reported_at, bleed_2_open, crossfeed_open from reports")
    assert report == ("08", world["at"], False, True)


def test_report_of_other_aircraft_is_refused(query):
    ((detail, n_rows),) = query("select detail, n_rows from quarantine where reason = 'other_aircraft'")
    assert "is of AA-0001" in detail
    assert n_rows == 1


def test_coverage_names_missing_signals(query):
    lacks = dict(query("select parameter, missing from coverage where operator = 'SAB' and status = 'not_recorded'"))
    assert lacks["hx_fouling"] == "ram_door_pct, pack_flow_lbpm"


def test_doctor_names_missing_signals(world):
    checks = {c.name: c for c in examine(world["landing"], None)}
    assert checks["type A330-717"].well
    assert "can't estimate hx_fouling (no ram_door_pct, pack_flow_lbpm)" in checks["type A330-717"].message
    assert not checks["type slip.toml"].well


def test_accepted_spray_makes_calibration_stale(world):
    ledger = Ledger(world["home"])
    assert find_stale_cells(ledger, STAGE["calibration_components"]).is_empty()
    (world["home"] / "terms.txt").write_text("water_spray\n")
    assert find_stale_cells(ledger, STAGE["calibration_components"])["operator"].to_list() == ["SAA", "SAB"]


@pytest.fixture(scope="module")
def real(tmp_path_factory) -> Path:
    """Home after a night over the two real recordings."""
    if not REFERENCE.is_dir():
        pytest.skip(f"no real recordings in {REFERENCE}: set HDT_REFERENCE")
    top = tmp_path_factory.mktemp("real")
    names = {"XXA/B-6789": "b787_767.zip", "XXB/B-8888": "a330_717.wgl.zip"}
    for aircraft, name in names.items():
        folder = top / "landing" / aircraft / "recorder"
        folder.mkdir(parents=True)
        shutil.copy(REFERENCE / name, folder / f"{aircraft[4:]}_20240203_01.zip")
    shutil.copytree(top / "landing/XXB/B-8888/recorder", top / "landing/XXB/B-8888/reports")
    (top / "landing/types").mkdir()
    for name in ("b787.vec", "a330.vec"):
        shutil.copy(REFERENCE / name, top / "landing/types" / name)
    (top / "landing/fleet.csv").write_text("operator,tail,packs,type\nXXA,B-6789,2,B787-767\nXXB,B-8888,2,A330-717\n")
    night = run(top / "landing", top / "home")
    assert not night.failed, night.failed
    return top / "home"


def read_by_another(recording: str, *names: str) -> list[np.ndarray]:
    """Values of parameters as an independent decoder reads them."""
    rows = pl.read_parquet(REFERENCE / f"decoded_{recording}.parquet")
    return [rows.filter(parameter=name).sort("t_s")["value"].drop_nulls().to_numpy() for name in names]


def readings(home: Path, tail: str) -> dict[tuple[int, str], tuple[float, float, str]]:
    """Readings of an aircraft's declared components by pack and name, from the rows that a night stored."""
    with connect(home) as con:
        rows = con.sql(f"from tables.raw_components where tail = '{tail}'").pl()
    frames = [
        component_readings(component_samples(rows.filter(component=code), components()[code]), components()[code])
        for code in rows["component"].unique()
    ]
    values = pl.concat(frames).select("pack", "parameter", "value", "sd", "status").iter_rows()
    return {(pack, name): (value, sd, status) for pack, name, value, sd, status in values}


def test_real_taxi_equals_other_decoder(real):
    of_taxi = readings(real, "B-6789")
    hot_in, hot_out, outside, speed = read_by_another(
        "767", "CASRPACKCOTEMPMP__01", "CASRSECHXOTEMPMP__01", "ENGTATSEL_EECGER", "CASRCAC2RPMPM_CTL_01"
    )
    right = (hot_in - hot_out) / (hot_in - outside.mean())
    assert of_taxi[2, "hxt_effectiveness"] == (
        pytest.approx(right.mean(), abs=0.001), pytest.approx(right.std(), abs=0.0005), "measured")  # fmt: skip
    assert of_taxi[1, "hxt_effectiveness"] == (
        pytest.approx(1.0, abs=0.001), pytest.approx(0.005, abs=0.001), "one_or_more")  # fmt: skip
    assert of_taxi[4, "cac_speed_rpm"][0] == pytest.approx(speed.mean(), rel=1e-3)
    for unit in (3, 4):
        assert 0.785 < of_taxi[unit, "cac_efficiency_seen"][0] < 0.815
    for pack in (1, 2):
        assert of_taxi[pack, "hxt_fan_rpm"][::2] == (pytest.approx(11_220, abs=10), "measured")


def test_real_taxi_is_no_flight(real):
    assert ask(real, "select tail, reason from held_flights") == [("B-6789", "no_flight")]
    assert ask(real, "select distinct tail from flights") == [("B-8888",)]


def test_real_climb_reaches_catalog(real):
    health = {(p, n): (v, sd, s) for p, n, v, sd, s in ask(
        real, "select pack, parameter, value, sd, status from health_parameters where tail = 'B-8888'")}  # fmt: skip
    for pack in (1, 2):
        assert 0.85 < health[pack, "hxt_effectiveness_slow"][0] < 0.90
        assert health[pack, "hxt_effectiveness_fast"][2] == "one_or_more"
        assert health[pack, "hxt_fan_rpm"][2] == "not_recorded"
        assert health[pack, "hxt_loss"][::2] == (pytest.approx(0.0, abs=0.01), "prior_only")
    assert np.isfinite([v for v, _, s in health.values() if s in {"prior_only", "measured"}]).all()


@pytest.mark.parametrize(
    ("question", "answer"),
    [
        ("select count(*) from alerts", [(0,)]),
        ("select distinct reason from quarantine order by 1", [("unknown_report",)]),
        ("select * from component_legs where reason = 'BLEED'", []),
        ("select * from quarantine where file like '%reports%' and scope <> 'note'", []),
    ],
)
def test_real_climb_has_no_fault(real, question, answer):
    assert ask(real, question) == answer


def test_real_reports_reach_catalog(real):
    rows = ask(real, "select report, bool_or(crossfeed_open) from reports group by 1 order by 1")
    assert [report for report, _ in rows] == ["08", "10", "13", "15", "18", "37", "50"]
    assert dict(rows)["10"]  # an engine is started by the other's air
