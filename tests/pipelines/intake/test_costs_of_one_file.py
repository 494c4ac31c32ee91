"""What one bad file may cost: its own rows, a second, a bounded list; never another file's."""

import os
import subprocess
import sys
import time
from hashlib import blake2b

import polars as pl
import pytest
from spoils import claims_too_much, long_words

from pipelines.intake import snapshots

CSV = "AQX/LX-AAA/acms/LX-AAA_20240525_04.csv"
N = 42  # rows of the good flight


def test_a_hostile_number_of_bad_rows_is_counted_and_not_listed(good_flight, deliver, read):
    head = good_flight.splitlines(keepends=True)[0]
    lines = read(deliver({CSV: head + b"x\n" * 30_000}))
    rows = read(deliver({CSV: head + good_flight.splitlines(keepends=True)[1].replace(b",1,", b",9,", 1) * 30_000}))
    for intake, reason in ((lines, "wrong_field_count"), (rows, "bad_pack")):
        assert set(intake.quarantine["reason"]) == {reason}
        assert intake.quarantine.height == 10_001
        assert intake.quarantine["n_rows"].sum() == 30_000 == intake.delivered["n_delivered"].sum()


def test_a_file_beyond_the_limit_is_refused_unread(good_flight, deliver, read, monkeypatch):
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
def test_megabytes_of_lines_that_are_no_report_are_refused_at_once(head, line, reason, deliver, read):
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
def test_a_file_nobody_foresaw_costs_itself_alone(error, good_flight, deliver, read, monkeypatch):
    """Whatever fails, an error or a panic, and wherever: the batch is halved until the one file is found."""
    files = deliver({f"AQX/LX-AAA/acms/copy {i}.csv": good_flight for i in range(7)})
    real = snapshots.validate_rows

    def sick(raw, files, now):
        if any("copy 4" in file.path for file in files):
            raise error("something new")
        return real(raw, files, now)

    monkeypatch.setattr(snapshots, "validate_rows", sick)
    intake = read(files)
    assert intake.rows.height == 6 * N
    failed = intake.quarantine.filter(pl.col("reason") == "cannot_process")
    assert failed["file"].to_list() == ["AQX/LX-AAA/acms/copy 4.csv"]
    assert "something new" in failed["detail"].item()


UNDER_A_LIMIT = """
import resource, sys
from datetime import UTC, datetime
from pathlib import Path
from pipelines.intake.landing import list_landing
from pipelines.intake.snapshots import read_snapshots
held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (held + (600 << 20),) * 2)
intake = read_snapshots(list_landing(Path(sys.argv[1])).files, datetime(2026, 1, 1, tzinfo=UTC))
print(sorted(set(intake.quarantine["reason"])), intake.rows.height)
"""


def test_parquet_that_unpacks_to_more_than_memory_is_refused_before_it_is_unpacked(good_flight, deliver, tmp_path):
    """In a process that may take 600 MB more: the bombs cost no memory, and the good file beside them is read."""
    bombs = {"history_2024-06.parquet": claims_too_much, "history_2024-07.parquet": long_words}
    deliver({f"AQX/LX-AAA/acms/{name}": make(good_flight) for name, make in bombs.items()} | {CSV: good_flight})
    one_thread = os.environ | {"POLARS_MAX_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", UNDER_A_LIMIT, tmp_path], env=one_thread, capture_output=True, text=True, check=False
    )
    assert done.stdout.strip() == f"['too_large'] {N}", done.stderr
