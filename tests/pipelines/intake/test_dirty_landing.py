"""Every row of tests/data/dirty/expected.md; the flight of the how-to; and what one bad file may cost at the most."""

import os
import re
import subprocess
import sys
import time
from hashlib import blake2b
from pathlib import Path

import polars as pl
import pytest
from accounts import balances
from pages import walk
from polars.testing import assert_frame_equal
from spoils import claims_too_much, long_words

from pipelines.intake import snapshots
from pipelines.intake.landing import list_landing
from pipelines.intake.logs import read_fleet, read_maintenance, read_messages
from pipelines.intake.merge import merge_deliveries
from pipelines.intake.snapshots import read_snapshots

ROOT = Path(__file__).parents[2] / "data" / "dirty"
PROJECT = Path(__file__).parents[3]

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
    "AQX/LX-AAB/acms/LX-AAB_20240604_01.csv": ("time_contradicts_flight_id", "row", 62, 62, 0, "report_time"),
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


def test_table_lists_every_expected_file():
    files = re.findall(r"^\| `([^`]+)` \|", (ROOT / "expected.md").read_text(), re.MULTILINE)
    assert sorted(files) == sorted(EXPECTED)


@pytest.mark.parametrize("path", EXPECTED)
def test_file_ends_as_expected(path, intake, logs):
    reason, scope, n_entries, n_out, n_read, columns = EXPECTED[path]
    log = logs.get(path)
    rows = intake.rows.filter(pl.col("file") == path) if log is None else log.rows
    faults = intake.quarantine.filter(pl.col("file") == path) if log is None else log.quarantine
    assert (rows.height, faults["n_rows"].sum(), faults.height) == (n_read, n_out, n_entries)
    if reason:
        assert faults.select("reason", "scope").unique().rows() == [(reason, scope)]
        assert columns in faults["column_name"].fill_null("").str.join("; ").item()
    if scope in ("row", "value"):
        assert faults["row"].null_count() == 0
    if scope == "row":
        assert faults["content"].null_count() == 0


def test_no_other_file_is_reported(landing, intake, logs):
    others = [p for p in (*intake.quarantine["file"], *logs) if p not in EXPECTED and p != "fleet.csv"]
    assert others == []
    assert landing.quarantine.is_empty()


def test_fleet_list_is_read_whole(logs):
    fleet = logs["fleet.csv"]
    assert (fleet.rows.height, fleet.quarantine.height) == (8, 0)


def test_repeated_rows_are_stored_once(landing, intake):
    merged = merge_deliveries([intake.rows], {f.path: f.received_at for f in landing.files})
    assert dict(merged.duplicates.select("file", "n_duplicate").rows()) == {
        "AQX/LX-AAA/acms/LX-AAA_20240606_02.csv": 48,
        "AQX/LX-AAB/acms/LX-AAB_20240606_01.csv": 100,
    }
    assert merged.quarantine.is_empty()
    assert balances(intake.delivered, merged.rows, merged.duplicates, intake.quarantine)


def test_flight_of_howto_is_taken_in(monkeypatch):
    """As the recorder gave it."""
    monkeypatch.chdir(PROJECT)
    page = walk("raw-data.md")
    written = list_landing(page["landing"])
    sample = list_landing(PROJECT / "data_samples")
    mine = read_snapshots([f for f in written.files if f.tail == "9H-XYZ"])
    same = read_snapshots([f for f in sample.files if f"data_samples/{f.path}" == page["sample"]])
    assert written.quarantine.height == mine.quarantine.height == 0
    assert mine.rows["operator"].unique().to_list() == ["XYZ"]
    columns = ["time_utc", "pack", "altitude_m", "mach", "tat_k", "total_pressure_pa", "hx_in_k", "hx_out_k",
             "ram_door_open", "pack_flow_kg_s"]  # fmt: skip
    assert mine.rows.height == same.rows.height > 30
    assert_frame_equal(mine.rows.select(columns), same.rows.select(columns), rel_tol=1e-6)
    assert mine.rows.select(pl.col("ram_out_k", "cc_speed_rad_s").is_null().all()).row(0) == (True, True)


CSV = "AQX/LX-AAA/acms/LX-AAA_20240525_04.csv"
N = 42  # rows of the good flight


def test_hostile_number_of_faults_is_counted(good_flight, deliver, read):
    head = good_flight.splitlines(keepends=True)[0]
    lines = read(deliver({CSV: head + b"x\n" * 30_000}))
    rows = read(deliver({CSV: head + good_flight.splitlines(keepends=True)[1].replace(b",1,", b",9,", 1) * 30_000}))
    for intake, reason in ((lines, "wrong_field_count"), (rows, "bad_pack")):
        assert set(intake.quarantine["reason"]) == {reason}
        assert intake.quarantine.height == 10_001
        assert intake.quarantine["n_rows"].sum() == 30_000 == intake.delivered["n_delivered"].sum()


def test_oversized_file_is_refused_unread(good_flight, deliver, read, monkeypatch):
    monkeypatch.setattr("pipelines.intake.landing_file.MAX_TEXT_BYTES", 1000)
    assert read(deliver({CSV: good_flight})).quarantine["reason"].to_list() == ["too_large"]


MEGABYTES = {
    "other columns": (b"a,b\n", b"a,b\n", "missing_columns"),
    "no header": (b"", b"1,2\n", "no_header"),
    "semicolons": (b"a;b\n", b"1;2\n", "wrong_separator"),
    "old Macintosh": (b"a,b\r", b"a,b\r", "missing_columns"),
    "the right header": (b"flight_id,report_time,pack,mach\n", b"x\n", "too_large"),
    "one line": (b"", b"a,", "no_header"),
}


@pytest.mark.parametrize(("head", "line", "reason"), MEGABYTES.values(), ids=list(MEGABYTES))
def test_megabytes_of_junk_are_refused_quickly(head, line, reason, deliver, read):
    n = (60 << 20) // len(line)
    files = deliver({CSV: head + line * n})
    began = time.process_time()
    blake2b(head + line * n)
    hashed = time.process_time() - began
    intake = read(files)
    assert time.process_time() - began < 25.0 * hashed  # some three times; it was six hundred
    assert intake.quarantine["reason"].to_list() == [reason]
    assert intake.delivered["n_delivered"].sum() == (0 if line == b"a," else n)


@pytest.mark.parametrize("error", [RuntimeError, pl.exceptions.PanicException])
def test_unforeseen_failure_costs_one_file(error, good_flight, deliver, read, monkeypatch):
    """Whatever fails, an error or a panic, and wherever: the batch is halved until the one file is found."""
    files = deliver({f"AQX/LX-AAA/acms/copy {i}.csv": good_flight for i in range(7)})
    real = snapshots.validate_rows

    def sick(raw, files):
        if any("copy 4" in file.path for file in files):
            raise error("something new")
        return real(raw, files)

    monkeypatch.setattr(snapshots, "validate_rows", sick)
    intake = read(files)
    assert intake.rows.height == 6 * N
    failed = intake.quarantine.filter(pl.col("reason") == "cannot_process")
    assert failed["file"].to_list() == ["AQX/LX-AAA/acms/copy 4.csv"]
    assert "something new" in failed["detail"].item()


UNDER_A_LIMIT = """
import resource, sys
from pathlib import Path
from pipelines.intake.landing import list_landing
from pipelines.intake.snapshots import read_snapshots
held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (held + (600 << 20),) * 2)
intake = read_snapshots(list_landing(Path(sys.argv[1])).files)
print(sorted(set(intake.quarantine["reason"])), intake.rows.height)
"""


def test_parquet_bomb_is_never_unpacked(good_flight, deliver, tmp_path):
    """In a process that may take 600 MB more: the bombs cost no memory, and the good file beside them is read."""
    bombs = {"history_2024-06.parquet": claims_too_much, "history_2024-07.parquet": long_words}
    deliver({f"AQX/LX-AAA/acms/{name}": make(good_flight) for name, make in bombs.items()} | {CSV: good_flight})
    one_thread = os.environ | {"POLARS_MAX_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", UNDER_A_LIMIT, tmp_path]
    done = subprocess.run(command, env=one_thread, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == f"['too_large'] {N}", done.stderr
