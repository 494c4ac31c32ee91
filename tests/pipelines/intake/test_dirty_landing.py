"""Every row of tests/data/dirty/expected.md: what is wrong with each file, and what became of it."""

import re
from pathlib import Path

import polars as pl
import pytest
from accounts import account

from pipelines.intake.landing import list_landing
from pipelines.intake.logs import read_fleet, read_maintenance, read_messages
from pipelines.intake.merge import merge_deliveries

ROOT = Path(__file__).parents[2] / "data" / "dirty"

# file: reason, scope, entries, rows kept out, rows read, columns that must be named
EXPECTED: dict[str, tuple[str | None, str | None, int, int, int, str]] = {
    "AQX/LX-AAA/acms/LX-AAA_20240525_04.csv": (None, None, 0, 0, 42, ""),
    "AQX/LX-AAB/acms/LX-AAB_20240602_01.csv": (None, None, 0, 0, 84, ""),
    "AQX/LX-AAA/acms/LX-AAA_20240604_01.csv": (None, None, 0, 0, 70, ""),
    "AQX/LX-AAB/acms/LX-AAB_20240602_02.csv": ("cut_short", "row", 1, 1, 55, ""),
    "AQX/LX-AAA/acms/LX-AAA_20240604_02.csv": ("empty_file", "file", 1, 0, 0, ""),
    "AQX/LX-AAB/acms/LX-AAB_20240602_03.csv": ("no_rows", "file", 1, 0, 0, ""),
    "AQX/LX-AAA/acms/LX-AAA_20240604_03.csv": ("no_header", "file", 1, 102, 0, "flight_id"),
    "AQX/LX-AAB/acms/LX-AAB_20240602_04.csv": ("missing_columns", "file", 1, 106, 0, "hx_in_degc, pack_flow_lbpm"),
    "AQX/LX-AAA/acms/LX-AAA_20240604_04.csv": ("wrong_field_count", "row", 1, 1, 87, ""),
    "AQX/LX-AAB/acms/LX-AAB_20240603_01.csv": ("wrong_separator", "file", 1, 174, 0, ""),
    "AQX/LX-AAA/acms/LX-AAA_20240605_01.csv": ("not_a_number", "value", 38, 0, 114, "hx_in_degc"),
    "AQX/LX-AAB/acms/LX-AAB_20240603_02.csv": ("unit_kpa", "row", 186, 186, 0, "pt_psia"),
    "AQX/LX-AAA/acms/LX-AAA_20240605_02.csv": ("unit_kelvin", "row", 80, 80, 0, "tat_degc"),
    "AQX/LX-AAB/acms/LX-AAB_20240604_01.csv": ("future_time", "row", 62, 62, 0, "report_time"),
    "AQX/LX-AAA/acms/LX-AAA_20240605_03.csv": ("unreadable_time", "row", 100, 100, 0, "report_time"),
    "AQX/LX-AAB/acms/LX-AAB_20240604_02.csv": ("bad_flight_id", "row", 1, 1, 55, "flight_id"),
    "AQX/LX-AAA/acms/LX-AAA_20240605_04.csv": ("flight_id_contradicts_path", "row", 108, 108, 0, "flight_id"),
    "AQX/LX-AAB/acms/LX-AAB_20240604_03.csv": ("bad_flight_id", "row", 40, 40, 0, "flight_id"),
    "AQX/LX-AAA/acms/LX-AAA_20240606_01.csv": ("bad_pack", "row", 1, 1, 43, "pack"),
    "AQX/LX-AAB/acms/LX-AAB_20240605_01.csv": ("out_of_range", "value", 2, 0, 102, "altitude_ft"),
    "AQX/LX-AAA/acms/LX-AAA_20240606_02.csv": (None, None, 0, 0, 96, ""),
    "AQX/LX-AAB/acms/LX-AAB_20240605_02.csv": ("not_text", "file", 1, 0, 0, ""),
    "AQX/LX-AAA/acms/LX-AAA_20240606_03.csv": ("bad_bytes", "row", 1, 1, 41, ""),
    "AQX/LX-AAB/acms/LX-AAB_20240605_03.csv.part": (None, None, 0, 0, 0, ""),
    "AQX/LX-AAA/acms/NOT_A_FLIGHT.csv": ("flight_id_from_column", "note", 1, 0, 80, ""),
    "AQX/LX-AAB/acms/LX-AAB_20240606_01 (1).csv": ("flight_id_from_column", "note", 1, 0, 100, ""),
    "AQX/LX-AAA/cpl/LX-AAA_20240607_02.parquet": ("cannot_read_parquet", "file", 1, 0, 0, ""),
    "AQX/LX-AAA/messages.csv": ("unreadable_time", "row", 1, 1, 0, "message_time"),
    "AQX/LX-AAB/maintenance.csv": ("missing_columns", "file", 1, 1, 0, "done_on, pack, component, action"),
}


@pytest.fixture(scope="module")
def landing():
    return list_landing(ROOT / "landing")


@pytest.fixture(scope="module")
def intake(landing, read):
    return read([f for f in landing.files if f.kind in ("acms", "history", "cpl")])


@pytest.fixture(scope="module")
def logs(landing, now):
    readers = {"messages": read_messages, "maintenance": read_maintenance, "fleet": read_fleet}
    return {f.path: readers[f.kind](f, now) for f in landing.files if f.kind in readers}


def test_table_holds_every_file_of_expected_md():
    files = re.findall(r"^\| `([^`]+)` \|", (ROOT / "expected.md").read_text(), re.MULTILINE)
    assert sorted(files) == sorted(EXPECTED)


@pytest.mark.parametrize("path", EXPECTED)
def test_becomes_what_is_expected(path, intake, logs):
    reason, scope, n_entries, n_out, n_read, columns = EXPECTED[path]
    log = logs.get(path)
    rows = intake.rows.filter(pl.col("file") == path) if log is None else log.rows
    faults = intake.quarantine.filter(pl.col("file") == path) if log is None else log.quarantine
    assert rows.height == n_read
    assert faults["n_rows"].sum() == n_out
    assert faults.filter(pl.col("reason") == reason if reason else True).height == n_entries == faults.height
    if reason:
        assert set(faults["scope"]) == {scope}
        assert columns in faults["column_name"].fill_null("").str.join("; ").item()
    if scope in ("row", "value"):
        assert faults["row"].null_count() == 0
    if scope == "row":
        assert faults["content"].null_count() == 0


def test_nothing_else_is_reported(landing, intake, logs):
    assert landing.quarantine.is_empty()
    others = [p for p in (*intake.quarantine["file"], *logs) if p not in EXPECTED and p != "fleet.csv"]
    assert not others
    assert logs["fleet.csv"].rows.height == 8
    assert logs["fleet.csv"].quarantine.is_empty()


def test_repeated_rows_are_stored_once_and_the_ledger_balances(landing, intake):
    merged = merge_deliveries([intake.rows], {f.path: f.received_at for f in landing.files})
    assert dict(merged.duplicates.select("file", "n_duplicate").rows()) == {
        "AQX/LX-AAA/acms/LX-AAA_20240606_02.csv": 48,
        "AQX/LX-AAB/acms/LX-AAB_20240606_01.csv": 100,
    }
    assert merged.quarantine.is_empty()
    assert account(intake.delivered, merged.rows, merged.duplicates, intake.quarantine)["balanced"].all()
