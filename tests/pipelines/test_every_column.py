"""Every column of the contract arrives in the catalog as it was delivered, words with markup through to the report."""

import html
import re
from datetime import UTC, date, datetime
from functools import cache
from pathlib import Path

import polars as pl
import pytest
from answers import query
from nights import keep_base, run
from polars.testing import assert_series_equal
from zones import simulated

from pipelines.report.page import write_report
from pipelines.storage.catalog import connect

CONTRACT = (Path(__file__).parents[2] / "docs" / "raw-data.md").read_text()
MARKUP = '<b onmouseover="alert(1)">HOT</b> & "HIGH"; äöü €, 100 %'
UNITS = {  # NIST SP 811
    "ft": lambda v: v * 0.3048,
    "degc": lambda v: v + 273.15,
    "psia": lambda v: v * 6894.757293,
    "pct": lambda v: v / 100,
    "lbpm": lambda v: v * 7.559873e-3,
    "rpm": lambda v: v * 0.1047197551,
}
STORED = {"altitude_ft": "altitude_m", "mach": "mach", "tat_degc": "tat_k", "pt_psia": "total_pressure_pa",
          "ram_door_pct": "ram_door_open", "vda_pos": "vda_counts", "report_time": "time_utc"}  # fmt: skip


def columns_of(heading: str) -> list[str]:
    """Columns that a section of the contract names: in a table, in a list, in a sentence on optional ones."""
    section = CONTRACT.split(heading)[1].split("\n### ")[0]
    tabled = [n for line in re.findall(r"^\| (`.*?) \|", section, re.MULTILINE) for n in re.findall(r"`(\w+)`", line)]
    listed = re.findall(r"^`(\w+, [\w, ]+)`", section, re.MULTILINE)
    optional = re.findall(r"`(\w+)`", section.split("Optional")[1].split(".")[0]) if "Optional" in section else []
    return [*tabled, *(n for line in listed for n in line.split(", ")), *optional]


RECORDED = columns_of("### `acms/*.csv`")
LOGS = {name: columns_of(f"### `{name}.csv`") for name in ("fleet", "messages", "maintenance")}


def si_name(column: str) -> str:
    """What the tables call a recorded column."""
    if column in STORED:
        return STORED[column]
    stem, _, unit = column.rpartition("_")
    ends = {"degc": "k", "psia": "pa", "lbpm": "kg_s", "rpm": "rad_s"}
    return f"{stem}_{ends[unit]}" if unit in ends else column


@pytest.fixture(scope="module")
def zone():
    """A flight with every sensor and word the contract knows, other values in every column."""
    zone = simulated(21, 2, operator="QQX", tail="Z9")
    words = {"origin": pl.lit("LOWW"), "destination": pl.lit("EDDF")}
    zone.snapshots = zone.snapshots.with_columns(**words, ram_out_degc=pl.col("hx_out_degc") + 30.0)
    zone.cpl = {f: zone.only([f]).snapshots.drop("phase_code") for f in zone.flights}
    flight = zone.flights[0]
    moment = zone.snapshots["report_time"].min()
    message = {"message_time": moment, "flight_id": flight, "pack": 2, "code": "21-52-HXTEMP", "text": MARKUP}
    work = {"done_on": moment.date(), "pack": 1, "component": "SENSOR", "action": "ADJUSTED"}
    work |= {
        "finding": "NO_FAULT_FOUND", "reference": "WO <i>7</i>", "serial_off": "S/N 1 & 2", "serial_on": "<s>3</s>",
    }  # fmt: skip
    zone.messages = pl.DataFrame([message])
    zone.maintenance = pl.DataFrame([work])
    fleet = {"operator": "QQX", "tail": "Z9", "msn": "<u>41</u>", "delivered_on": date(2014, 6, 1), "packs": 2}
    zone.fleet = pl.DataFrame([fleet | {"type": "B787-767"}])
    return zone


@pytest.fixture(scope="module")
def home(zone, sample_home, tmp_path_factory):
    root = tmp_path_factory.mktemp("every_column")
    landing = root / "landing"
    home = root / "home"
    one, two = zone.flights
    zone.only([one]).drop_csv(landing)
    zone.only([two]).drop_history(landing)
    zone.only([two]).drop_logs(landing)
    zone.drop_papers(landing)
    zone.fleet.write_csv(landing / "fleet.csv")
    keep_base(sample_home, home)
    assert run(landing, home).failed == {}
    assert query(home, "select * from quarantine") == []
    return home


@cache
def table(home: Path, name: str) -> pl.DataFrame:
    with connect(home) as con:
        return con.sql(f"select * from tables.{name}").pl()


def test_contract_names_every_column():
    assert len(RECORDED) == len(set(RECORDED)) == 22
    assert [len(columns) for columns in LOGS.values()] == [6, 5, 8]


def test_route_is_read_as_written(zone, home):
    rows = query(home, "select flight_id, origin, destination from flights order by flight_id")
    assert rows == [(f, "LOWW", "EDDF") for f in zone.flights]


def test_message_is_read_as_written(home, tmp_path):
    write_report(home, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert MARKUP not in page
    assert MARKUP in html.unescape(page).replace("\N{NO-BREAK SPACE}", " ")  # which keeps a % on its number's line


@pytest.mark.parametrize("column", RECORDED)
@pytest.mark.parametrize(("name", "nth"), [("raw_snapshots", 0), ("raw_snapshots", 1), ("raw_logs", 1)])
def test_recorded_column_arrives(name, nth, column, zone, home):
    """From CSV, from history, from a continuous log."""
    flight = zone.flights[nth]
    delivered = zone.cpl[flight] if name == "raw_logs" else zone.snapshots.filter(flight_id=flight)
    if column not in delivered.columns:
        assert column == "phase_code"
        return
    delivered = delivered.sort("report_time", "pack")[column]
    stored = table(home, name).filter(flight_id=flight).sort("time_utc", "pack")[si_name(column)]
    assert delivered.len() > 30
    if delivered.dtype.is_float():
        convert = UNITS.get(column.rpartition("_")[2], lambda v: v)
        assert_series_equal(stored, convert(delivered), check_names=False, rel_tol=1e-6)
    else:
        assert stored.cast(delivered.dtype).to_list() == [v or None for v in delivered]  # an empty word is none


@pytest.mark.parametrize(("log", "column"), [(log, c) for log, columns in LOGS.items() for c in columns])
def test_column_of_log_arrives(log, column, zone, home):
    delivered = getattr(zone, log)[column].item()
    stored = table(home, f"raw_{log}")[column].item()
    if isinstance(stored, datetime):
        stored = stored.astimezone(UTC)
    assert stored == delivered
