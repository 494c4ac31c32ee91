"""A component of one's own, declared in a package of one's own: from its files to alert, prognosis and report.

Two of them in one fleet: the rig's cooler as the how-to page declares and delivers it, and an air compressor with known
truth. Nothing of the project is edited: each package is found by its entry point.
"""

import os
import re
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from answers import query
from packages import install
from soundness import faults

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/howto-component.md").read_text(encoding="utf-8").split("## Physics from an FMU")[0]
HDT = Path(sys.executable).parent / "hdt"
COMPRESSOR = '''
"""An air compressor that supplies nitrogen generation: isentropic efficiency, of which wear takes a share."""

from hdt_core.components import Channel, Component, Limit, Record
from hdt_core.physics.model import Param, PhysicsModel, Signal


def exit_k(*, inlet_k, pressure_ratio, ng_efficiency, ng_efficiency_loss):
    """Exit temperature of air at a constant ratio of heat capacities of 1.4. [K]"""
    work = (pressure_ratio ** (0.4 / 1.4) - 1.0) / (ng_efficiency * (1.0 - ng_efficiency_loss))
    return inlet_k * (1.0 + work)


NITROGEN = Component(
    code="NG", name="nitrogen compressor", lost="Efficiency lost", loss="ng_efficiency_loss",
    model=PhysicsModel(
        name="nitrogen_compressor",
        inputs=(Signal("inlet_k", "K"), Signal("pressure_ratio", "-")),
        outputs=(Signal("exit_k", "K", sigma=0.7),),
        params=(
            Param("ng_efficiency", "-", 0.7, (0.4, 0.95), "design"),
            Param("ng_efficiency_loss", "-", 0.0, (-0.1, 0.6), "health", drift=0.002),
        ),
        equations=exit_k,
    ),
    limit=Limit(0.2, 0.03, 0.02), life_flights=250.0, warn_loss=0.08, message_code="47-31-NGTEMP", new_share=0.9,
    action="Borescope the compressor (ATA 47-31)", ended_by=("REPLACED",),
    record=Record(channels=(
        Channel("inlet_degc", "inlet_k", "K", "inlet", offset=273.15, low=180.0, high=400.0, harmful_per_s=0.2),
        Channel("ratio", "pressure_ratio", "-", "pressure ratio", low=1.0, high=10.0),
        Channel("exit_degc", "exit_k", "K", "exit", offset=273.15, low=200.0, high=700.0),
    )),
)
'''
FLIGHTS = 220
FAILS = 190
REPLACED = 193
TRUTH = {"AQ-WORN": 0.2 * np.clip((np.arange(FLIGHTS) - 30) / (FAILS - 30), 0.0, None), "AQ-SOUND": np.zeros(FLIGHTS)}
TRUTH["AQ-WORN"][REPLACED:] = 0.0
NG_COLUMNS = ["flight_id", "report_time", "pack", "inlet_degc", "ratio", "exit_degc"]


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)


def flight_id(tail: str, flight: int) -> str:
    return f"{tail}_{datetime(2024, 3, 1, tzinfo=UTC) + timedelta(days=flight):%Y%m%d}_01"


def compressor_flight(tail: str, flight: int) -> pl.DataFrame:
    """Twenty samples of one flight, with sensor noise, in the recorder's units."""
    rng = np.random.default_rng([flight, len(tail)])
    inlet = 255.0 + rng.normal(0, 6) + rng.normal(0, 0.1, 20)
    ratio = rng.uniform(2.0, 4.0, 20)
    loss = TRUTH[tail][flight]
    exit_k = inlet * (1.0 + (ratio ** (0.4 / 1.4) - 1.0) / (0.74 * (1.0 - loss))) + rng.normal(0, 0.7, 20)
    start = datetime(2024, 3, 1, 8, tzinfo=UTC) + timedelta(days=flight)
    when = [f"{start + timedelta(minutes=2 * k):%Y-%m-%dT%H:%M:%SZ}" for k in range(20)]
    values = [flight_id(tail, flight)] * 20, when, [2] * 20, inlet - 273.15, ratio, exit_k - 273.15
    return pl.DataFrame(dict(zip(NG_COLUMNS, values, strict=True)))


def deliver_compressors(landing: Path) -> None:
    for tail in TRUTH:
        folder = landing / "AQX" / tail / "ng"
        folder.mkdir(parents=True)
        for flight in range(FLIGHTS):
            compressor_flight(tail, flight).write_csv(folder / f"{flight_id(tail, flight)}.csv")
        with (landing / "fleet.csv").open("a") as fleet:
            fleet.write(f"AQX,{tail},2,2020-01-01,2\n")
    worn = landing / "AQX" / "AQ-WORN"
    failed = flight_id("AQ-WORN", FAILS)
    done = datetime(2024, 3, 1, tzinfo=UTC) + timedelta(days=REPLACED - 1)
    raised = f"{datetime(2024, 3, 1, 8, 30, tzinfo=UTC) + timedelta(days=FAILS):%Y-%m-%dT%H:%M:%SZ}"
    message = f"{raised},{failed},2,47-31-NGTEMP,NGS COMPR HOT"
    work = f"{done:%Y-%m-%d},2,NG,REPLACED,DAMAGED,WO-1"
    (worn / "messages.csv").write_text(f"message_time,flight_id,pack,code,text\n{message}\n")
    (worn / "maintenance.csv").write_text(f"done_on,pack,component,action,finding,reference\n{work}\n")


def spoil(landing: Path) -> None:
    """Bad rows among the good: a value no air can have, a text, a flight without a name, a pack that is none."""
    path = landing / "AQX/AQ-SOUND/ng" / f"{flight_id('AQ-SOUND', 7)}.csv"
    lines = path.read_text().splitlines()
    lines[2] = re.sub(r"[^,]*$", "99999", lines[2])
    lines[3] = re.sub(r"[^,]*$", "warm", lines[3])
    lines[4] = re.sub(r"^[^,]*", "../etc", lines[4])
    lines[5] = re.sub(r",2,", ",9,", lines[5], count=1)
    path.write_text("\n".join(lines) + "\n")
    (landing / "AQX/AQ-SOUND/ng/notes.txt").write_text("not a record")


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> dict[str, Any]:
    """Both packages, both deliveries, one night."""
    top = tmp_path_factory.mktemp("own")
    landing = top / "landing"
    home = top / "home"
    packages = top / "packages"
    declared, delivered = blocks("python")
    (entry,) = [line for line in blocks("toml")[0].splitlines() if "=" in line]
    install(packages, "rig", declared, entry.replace('"', ""))
    install(packages, "nitrogen", COMPRESSOR, "nitrogen = nitrogen:NITROGEN")
    with pytest.MonkeyPatch.context() as patched:
        patched.chdir(ROOT)
        exec(compile(delivered, "howto-component.md", "exec"), {"landing": landing})
    deliver_compressors(landing)
    spoil(landing)
    env = os.environ | {"PYTHONPATH": f"{ROOT}:{packages}", "OMP_NUM_THREADS": "1"}
    shared = {"landing": landing, "home": home, "env": env}
    done = hdt(shared, "nightly", "--landing", landing)
    assert done.returncode == 0, done.stdout + done.stderr
    return shared | {"stdout": done.stdout}


def hdt(world: dict[str, Any], *words: object) -> subprocess.CompletedProcess[str]:
    command = [str(HDT), *map(str, words), "--home", str(world["home"])]
    return subprocess.run(command, env=world["env"], capture_output=True, text=True, timeout=300, check=False)


def query_rows(world: dict[str, Any], sql: str) -> list[tuple[Any, ...]]:
    return query(world["home"], sql)


def test_howto_page_matches_the_night(world):
    (promised,) = blocks("text")
    assert hdt(world, "explain", "COOLER 1").stdout.startswith(promised.strip())
    assert "Other components most in need of attention" in world["stdout"]
    raised = query_rows(world, "select raised_flight_id, raised_severity from alerts where component = 'HC'")
    assert raised == [("CYCLE-0745", "high")]
    sql = "select value from health_parameters where parameter = 'hc_fouling' and flight_id = 'CYCLE-0745'"
    ((loss,),) = query_rows(world, sql)
    assert 0.45 < loss < 0.55


def test_queries_of_howto_page_answer(world):
    for command in blocks("")[1:]:
        for sql in re.findall(r'hdt query --home home "(.*)"', command):
            assert query_rows(world, sql)


@pytest.mark.parametrize("tail", TRUTH)
def test_estimated_loss_follows_the_truth(world, tail):
    """Within four of its own standard deviations, and 0.01 in the mean."""
    sql = f"""select flight_id, value, sd from health_parameters
        where parameter = 'ng_efficiency_loss' and tail = '{tail}' order by all"""
    estimates = {f: (v, sd) for f, v, sd in query_rows(world, sql)}
    off = [(estimates[flight_id(tail, k)][0] - TRUTH[tail][k]) for k in range(FLIGHTS)]
    assert np.abs(off).mean() < 0.01
    assert np.mean([abs(e) < 4 * estimates[flight_id(tail, k)][1] + 0.005 for k, e in enumerate(off)]) > 0.97


def test_alert_precedes_the_message(world):
    sql = "select tail, raised_flight_id, closed_at, recommended_action from alerts where component = 'NG'"
    ((tail, raised, closed, action),) = query_rows(world, sql)
    assert tail == "AQ-WORN"
    assert flight_id(tail, 60) < raised < flight_id(tail, 130)  # 8 % are lost at flight 94
    assert closed.date() == (datetime(2024, 3, 1, tzinfo=UTC) + timedelta(days=REPLACED)).date()
    assert action.startswith("Borescope")
    assert query_rows(world, "select outcome from alert_outcomes where component = 'NG'") == [("found",)]
    ((lead,),) = query_rows(world, "select lead_flights from alert_lead_times where component = 'NG'")
    assert 60 < lead < 130


def test_prognosis_covers_the_truth(world):
    what = "flight_id, rul_low, rul_flights, rul_high, p_event_50"
    prognoses = {f: row for f, *row in query_rows(world, f"select {what} from prognoses where tail = 'AQ-WORN'")}
    left = {k: FAILS - k for k in range(80, FAILS)}
    rows = [(left[k], *prognoses[flight_id("AQ-WORN", k)]) for k in left]
    coverage = np.mean([low <= truth <= high for truth, low, _, high, _ in rows])
    assert coverage > 0.85
    assert np.mean([abs(truth - middle) for truth, _, middle, _, _ in rows]) < 25
    assert rows[0][4] < 0.1
    assert rows[-1][4] > 0.5


def test_sound_compressor_has_no_message(world):
    sql = "select max(p_event_50) from prognoses where component = 'NG' and tail = 'AQ-SOUND'"
    assert query_rows(world, sql)[0][0] < 0.1


def test_bad_rows_cost_themselves_alone(world):
    sql = "select row, column_name, reason from quarantine where file like '%AQ-SOUND/ng/%' order by all"
    entries = set(query_rows(world, sql))
    assert {
        (3, "exit_degc", "out_of_range"), (4, "exit_degc", "not_a_number"), (5, None, "bad_cycle_id"),
        (6, None, "bad_pack"), (None, None, "unexpected_name"),
    } == entries  # fmt: skip
    sql = "select sum(delivered), sum(loaded), sum(quarantined) from deliveries where file like '%AQ-SOUND/ng/%.csv'"
    assert query_rows(world, sql) == [(20 * FLIGHTS, 20 * FLIGHTS - 2, 2)]
    assert faults(world["home"], world["landing"]) == []


def test_report_names_each_unit(world, tmp_path):
    page = tmp_path / "report.html"
    assert hdt(world, "report", "--out", page).returncode == 0
    text = page.read_text()
    assert "COOLER hydraulic oil cooler 1" in text
    assert "AQ-WORN nitrogen compressor 2" in text


def test_second_night_takes_new_flight(world):
    sql = "select tail, count(*) from component_features group by tail"
    before = dict(query_rows(world, sql))
    late = flight_id("AQ-SOUND", FLIGHTS)
    TRUTH["AQ-SOUND"] = np.append(TRUTH["AQ-SOUND"], 0.0)
    compressor_flight("AQ-SOUND", FLIGHTS).write_csv(world["landing"] / "AQX/AQ-SOUND/ng" / f"{late}.csv")
    done = hdt(world, "nightly", "--landing", world["landing"])
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"1 new of \d+ files, 3 cells in 3 runs", done.stdout), done.stdout
    assert dict(query_rows(world, sql)) == before | {"AQ-SOUND": before["AQ-SOUND"] + 1}
    assert "Nothing new" in hdt(world, "nightly", "--landing", world["landing"]).stdout
