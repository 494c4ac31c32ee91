"""Which files and settings a scan registers, and which it leaves alone."""

import os
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from pipelines.intake.scan import find_loss, list_new_files, scan
from pipelines.storage.ledger import Ledger

FLIGHT = "AQX/LX-AAA/acms/LX-AAA_20240525_04.csv"


@pytest.fixture
def zone(deliver, good_flight, tmp_path) -> tuple[Path, Ledger]:
    """A landing zone that was scanned, and its ledger."""
    deliver({"landing/fleet.csv": b"operator,tail\nAQX,LX-AAA\n", f"landing/{FLIGHT}": good_flight})
    ledger = Ledger(tmp_path / "home")
    scan(tmp_path / "landing", ledger)
    return tmp_path / "landing", ledger


def note_night(ledger: Ledger, minutes: float) -> None:
    """A night that begins so long from now."""
    began_at = datetime.now(UTC) + timedelta(minutes=minutes)
    ledger.note_night((began_at.isoformat(), "", 1, 1, 1, 1, "{}"))


@pytest.mark.parametrize(
    ("nights", "is_new"), [((30,), True), ((120,), False), ((-9_000, 120), False)], ids=["slow", "later", "last"]
)
def test_clocks_may_differ_by_an_hour(zone, nights, is_new):
    """A change before the last night was seen by it, unless the file system's clock is slow."""
    landing, ledger = zone
    for minutes in nights:
        note_night(ledger, minutes)
    file = landing / FLIGHT
    stat = file.stat()
    file.write_bytes(file.read_bytes().replace(b",CL,", b",DS,", 1))
    os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))

    assert (FLIGHT in [f.path for f in list_new_files(landing, ledger)[1]]) is is_new


@pytest.mark.parametrize("name", ["notes.txt", "AQX/LX-AAA/acms/notes.txt"])
def test_strange_entry_is_registered_once(zone, monkeypatch, name):
    landing, ledger = zone
    (landing / name).touch()
    scan(landing, ledger)

    monkeypatch.setattr(Ledger, "register", None)
    scan(landing, ledger)


def test_removed_costs_are_without_content(zone):
    landing, ledger = zone
    costs = ledger.home / "costs.toml"
    costs.write_text('currency = "EUR"\n')
    scan(landing, ledger)

    costs.unlink()
    scan(landing, ledger)

    assert ledger.file_records()["costs.toml"].digest == ""


@pytest.mark.parametrize(("had_list", "is_loss"), [(True, True), (False, False)])
def test_only_a_list_that_was_there_is_lost(zone, had_list, is_loss):
    landing, ledger = zone
    if not had_list:
        (landing / "fleet.csv").unlink()
    scanned = scan(landing, ledger)
    (landing / "fleet.csv").unlink(missing_ok=True)

    assert ("fleet.csv" in find_loss(landing, scanned, ledger.file_records())) is is_loss
