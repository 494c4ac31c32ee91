"""Commands that only look write nothing, not for a moment: on a read-only home they answer as on any other."""

import ctypes
import os
import sqlite3
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from command import command_line, hdt

from pipelines.storage.ledger import Ledger

_DROP_FROM_BOUNDING_SET = 24
_OVERRIDE_PERMISSIONS = 1

LOOKS = {
    "status": (),
    "query": ("select count(*) from fleet_ranking",),
    "query more than memory holds": ("select x from range(9000000) t(x) order by hash(x) limit 1",),
    "explain": ("LX-AAB",),
    "report": ("--out", "{out}/report.html"),
    "export": ("--out", "{out}/all"),
    "export of one operator": ("--out", "{out}/one", "--format", "duckdb", "--operator", "AQX"),
    "doctor": (),
    "nightly": ("--dry-run", "--landing", "{landing}"),
}


def as_anybody() -> None:
    """Root too is held to what permissions say."""
    if os.geteuid() == 0:
        assert ctypes.CDLL(None).prctl(_DROP_FROM_BOUNDING_SET, _OVERRIDE_PERMISSIONS, 0, 0, 0) == 0


def tree(home: Path) -> list[tuple[str, int, int]]:
    """All there is below a home; a folder's time tells of files that came and went."""
    return sorted((str(p), p.lstat().st_mtime_ns, p.lstat().st_size) for p in (home, *home.rglob("*")))


def permit(home: Path, writing: bool) -> None:
    for path in (home, *home.rglob("*")):
        path.chmod(path.stat().st_mode | 0o200 if writing else path.stat().st_mode & ~0o222)


@pytest.fixture
def read_only(own_home):
    landing, home = own_home
    permit(home, writing=False)
    yield landing, home
    permit(home, writing=True)


def words_of(command: str, landing: Path, home: Path, out: Path) -> list[str]:
    words = [w.format(out=out, landing=landing) for w in LOOKS[command]]
    return [command.split(maxsplit=1)[0], *words, "--home", str(home)]


@pytest.mark.parametrize("command", LOOKS)
def test_reading_needs_no_write_permission(read_only, tmp_path, command):
    landing, home = read_only
    run = command_line(*words_of(command, landing, home, tmp_path))
    done = subprocess.run(run, capture_output=True, text=True, check=False, preexec_fn=as_anybody)
    if command == "doctor":  # which is asked whether a night could run
        faults = [line for line in done.stdout.splitlines() if "FAULT" in line]
        assert faults == [f"FAULT  home: {home} is not writable"]
    else:
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("command", ["status", "query", "nightly", "doctor"])
def test_reading_leaves_no_trace(own_home, tmp_path, command):
    landing, home = own_home
    before = tree(home)
    assert hdt(*words_of(command, landing, home, tmp_path)).returncode == 0
    assert tree(home) == before


def test_killed_writers_ledger_reads_whole(own_home):
    """Its last commit is in the log beside it."""
    _, home = own_home
    writes = (
        "import os, sqlite3; con = sqlite3.connect('ledger.sqlite'); con.execute('pragma journal_mode=wal');"
        "con.execute(\"insert into files values ('new', '', '', 'acms', 1, 1, '')\"); con.commit(); os._exit(1)"
    )
    subprocess.run([sys.executable, "-c", writes], cwd=home, check=False)
    assert (home / "ledger.sqlite-wal").stat().st_size > 0
    permit(home, writing=False)
    try:
        assert Ledger(home, read_only=True).file_records()["new"][:2] == (1, 1)
    finally:
        permit(home, writing=True)


def test_ledger_reads_whole_while_written(tmp_path):
    """Each commit adds a pair, of which a reader sees both or none."""
    ledger = Ledger(tmp_path)
    over = threading.Event()
    n_files = []
    ledger.register([], {})

    def read() -> None:
        while not over.is_set():
            try:
                n_files.append(len(Ledger(tmp_path, read_only=True).file_records()))
            except sqlite3.Error as error:
                n_files.append(error)

    reader = threading.Thread(target=read)
    reader.start()
    for n in range(60):
        ledger.register([(f"{n}/{k}" * 50, "", "", "acms", 1, 1, "") for k in range(2)], {})
    over.set()
    reader.join()
    assert {n % 2 if isinstance(n, int) else n for n in n_files} == {0}
    assert n_files == sorted(n_files)
    assert max(n_files) > 2
