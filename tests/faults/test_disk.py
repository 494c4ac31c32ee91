"""A disk that is full, a home that may not be written, a power cut: what the file system can do to a night."""

import errno
import os
import re
import signal
import sqlite3
import tempfile
from itertools import count
from pathlib import Path

import pytest
from command import hdt
from nights import steps_up_to
from sqlalchemy.exc import OperationalError

from benchmarks import fault_points
from benchmarks.fault_points import fingerprint
from pipelines.orchestration import nightly
from pipelines.orchestration.runs import open_instance
from pipelines.storage import files
from pipelines.storage.ledger import Ledger

FULL = 2
"""SQLite's `synchronous`: every commit waits until it is on the disk."""


@pytest.mark.parametrize("limit", [3_000, 20_000, 100_000])
def test_file_size_limit_loses_nothing(tiny, children, intact, home, limit):
    """Parquet, SQLite and DuckDB writers all meet it; the smaller the limit, the earlier."""
    ended, message = children.night(tiny.landing, home, file_limit=limit)
    assert ended is None
    assert message
    intact(home)
    children.complete_night(tiny.landing, home)
    tiny.check_end(home)


@pytest.mark.parametrize(
    ("fault", "end"),
    [("before_write:1", None), ("before_rename:6", 0), ("before_mark:4", None), ("before_register:1", None)],
)
def test_night_recovers_from_full_disk(tiny, children, intact, home, fault, end):
    """A run whose parts have room is made in parts, and the night says so."""
    ended, message = children.night(tiny.landing, home, fault=f"{fault}:full", steps=3)
    assert ended == end
    assert "No space left on device" in message
    intact(home)
    children.complete_night(tiny.landing, home, steps=3)
    stored = {t: content for t, content in fingerprint(home).items() if t.startswith("raw_")}
    assert stored == {t: tiny.end[t] for t in stored}


def test_unwritable_home_stays_as_is(children):
    """The night stops with the reason, and leaves the home as it was. In a folder that anyone may enter."""

    def times() -> dict[Path, int]:
        return {f: f.stat().st_mtime_ns for f in home.rglob("*")}

    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        root.chmod(0o755)
        landing = root / "landing"
        home = children.home(root / "home")
        landing.mkdir()
        (landing / "fleet.csv").write_text("operator,tail\nQQX,Z9\n")
        before = times()
        for f in (home, *home.rglob("*")):
            f.chmod(0o555 if f.is_dir() else 0o444)
        ended, message = children.night(landing, home, nobody=True)
        for f in (home, *home.rglob("*")):
            f.chmod(0o755 if f.is_dir() else 0o644)
        assert ended is None
        assert "Permission denied" in message
        assert str(home) in message
        assert times() == before


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "x.part"), "hdt: No space left on device: x.part"),
        (sqlite3.OperationalError("database or disk is full"), "hdt: database or disk is full; free space"),
        (OperationalError("insert", {}, sqlite3.OperationalError("disk I/O error")), "hdt: disk I/O error; free space"),
    ],
)
def test_disk_error_takes_one_line(monkeypatch, tmp_path, error, line):
    def full(*_: object, **__: object) -> None:
        raise error

    (tmp_path / "fleet.csv").write_text("operator,tail,msn,delivered_on,packs\n")
    monkeypatch.setattr(nightly, "run_night", full)
    done = hdt("nightly", "--landing", tmp_path, "--home", tmp_path / "home")
    assert done.returncode == 2
    assert done.stderr.strip().startswith(line)
    assert len(done.stderr.strip().splitlines()) == 1


def test_file_is_synced_before_naming(tmp_path, monkeypatch):
    """A power cut drops what was not synced: content is synced before it is named, the name before it is told."""
    done = []
    sync = os.fsync
    replace = Path.replace

    def watched_sync(fd: int) -> None:
        done.append(f"sync {Path(os.readlink(f'/proc/self/fd/{fd}')).name}")
        sync(fd)

    def watched_replace(self: Path, target: Path) -> Path:
        done.append(f"{self.name} becomes {target.name}")
        return replace(self, target)

    monkeypatch.setattr(files.os, "fsync", watched_sync)
    monkeypatch.setattr(Path, "replace", watched_replace)
    with files.replacing(tmp_path / "shard.parquet") as temporary:
        temporary.write_bytes(b"whole")
    part = temporary.name
    assert done == [f"sync {part}", f"{part} becomes shard.parquet", f"sync {tmp_path.name}"]


def test_ledger_syncs_each_commit(tmp_path):
    """What it holds survives a power cut."""
    with Ledger(tmp_path)._database.transaction() as con:
        assert con.execute("pragma synchronous").fetchone() == (FULL,)


def test_history_syncs_each_commit(tmp_path):
    with open_instance(tmp_path) as instance:
        log = instance.event_log_storage
        for open_one in (log.index_connection, instance.run_storage.connect, lambda: log.run_connection("a-run")):
            with open_one() as con:
                assert con.exec_driver_sql("pragma synchronous").scalar() == FULL


def test_power_cuts_lose_nothing(tiny, children, intact, home):
    """Through a whole night, further on each time; every other cut takes Dagster's history of that night as well."""
    for place in count(3, 12):
        cut = {"lose_history": place % 24 == 3}
        ended, message = children.night(tiny.landing, home, fault=f"any:{place}", cut=cut)
        intact(home)
        if ended != signal.SIGKILL:
            break
    assert (ended, message) == (0, "")
    assert place > 30
    tiny.check_end(home)


def test_power_cut_takes_unsynced_files(tiny, children, home):
    """The simulated cut bites: with syncing off, the ledger speaks of files that are gone."""
    steps = steps_up_to("legs")
    ended, _ = children.night(tiny.landing, home, fault="before_mark:18", steps=steps, cut={"sync": False})
    assert ended == signal.SIGKILL
    children.night(tiny.landing, home, steps=steps)
    assert fingerprint(home)["raw_snapshots"] != tiny.end["raw_snapshots"]


def test_code_has_every_fault_point():
    sources = "".join(p.read_text() for p in Path(files.__file__).parent.glob("*.py"))
    points = set(re.findall(r'sys.audit\("hdt.(\w+)"\)', sources))
    assert points == {*fault_points.POINTS, *fault_points.OF_OBJECTS}
