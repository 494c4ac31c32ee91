"""A flight that comes again, with other values, fewer rows, at the same size and time: what is stored, what noted."""

import itertools
import os
import re
import shutil
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import polars as pl
import pytest
from spoils import Spoil, column, field, fields_of, joined, retimed

from pipelines.intake import scan as scan_module
from pipelines.intake.ingest import ingest_flights
from pipelines.intake.scan import list_new_files, scan
from pipelines.storage.ledger import Ledger
from pipelines.storage.store import Store

GOOD = Path(__file__).parents[1] / "data/dirty/landing/AQX/LX-AAA/acms/LX-AAA_20240525_04.csv"
AIRCRAFT = ("AQX", "LX-AAA")
FLIGHT = "LX-AAA_20240525_04"
CSV, COPY = (f"AQX/LX-AAA/acms/{name}.csv" for name in (FLIGHT, "copy"))
TAKEN_IN = ("raw_snapshots", "raw_deliveries", "raw_quarantine")
N = 42  # rows of the good flight


class Zone:
    """A landing zone and what was stored of its one flight."""

    def __init__(self, root: Path) -> None:
        self.landing = root / "landing"
        self.store = Store(root / "home")
        self.ledger = Ledger(root / "home")

    def deliver(self, path: str, spoil: Spoil = lambda content: content) -> None:
        """Put the good flight, changed, where it belongs."""
        (self.landing / path).parent.mkdir(parents=True, exist_ok=True)
        (self.landing / path).write_bytes(spoil(GOOD.read_bytes()))

    def night(self, meanwhile: Callable[[Path], None] = lambda landing: None) -> pl.DataFrame:
        """Take in what lies there; the stored rows. Accounts balance, and hold what is stored and set aside."""
        scan(self.landing, self.ledger)
        meanwhile(self.landing)
        intake = ingest_flights(self.landing, self.store, self.ledger, AIRCRAFT, [FLIGHT])
        for table, frame in zip(TAKEN_IN, (intake.rows, intake.deliveries, intake.quarantine), strict=True):
            self.store.merge(table, {AIRCRAFT: [FLIGHT]}, frame)
        account = self.store.read_table("raw_deliveries")
        quarantine = self.quarantine
        assert (account["delivered"] == account["loaded"] + account["quarantined"] + account["duplicate"]).all()
        assert (account["duplicate"] >= 0).all()
        assert account["loaded"].sum() == intake.rows.height
        aside = quarantine.group_by("file").agg(pl.col("n_rows").sum()).filter(pl.col("n_rows") > 0)
        per_file = account.filter(pl.col("quarantined") > 0).select("file", "quarantined")
        assert aside.sort("file").rows() == per_file.sort("file").rows()
        assert quarantine["received_at"].null_count() == 0
        return self.store.read_table("raw_snapshots")

    @property
    def new_paths(self) -> list[str]:
        """Files that the next night would take in."""
        return [f.path for f in list_new_files(self.landing, self.ledger)[1]]

    @property
    def quarantine(self) -> pl.DataFrame:
        """What is set aside or noted."""
        return self.store.read_table("raw_quarantine")

    def reasons(self) -> list[str]:
        """Reasons of it, each once."""
        return sorted(set(self.quarantine["reason"]))


@pytest.fixture
def zone(tmp_path) -> Zone:
    return Zone(tmp_path)


@pytest.fixture
def good_rows(zone) -> pl.DataFrame:
    """Rows of the good flight after a night."""
    zone.deliver(CSV)
    return zone.night()


def head(n: int) -> Spoil:
    """The first rows alone."""
    return lambda content: joined(fields_of(content)[: n + 1])


def warmer(content: bytes) -> bytes:
    """Another calibration of one sensor, in every row."""
    return column("hx_out_degc", lambda v: v + 2.0)(content)


def an_hour_later(content: bytes) -> bytes:
    return re.sub(rb"T(\d\d):", lambda hour: b"T%02d:" % (int(hour[1]) + 1), content)


def both(*spoils: Spoil) -> Spoil:
    """One after the other."""

    def spoil(content: bytes) -> bytes:
        for one in spoils:
            content = one(content)
        return content

    return spoil


def of_one_file(rows: pl.DataFrame) -> str:
    """The one file all stored rows are of."""
    (file,) = rows["file"].unique()
    return file


@pytest.mark.parametrize("paths", [(CSV, COPY), (COPY, CSV)])
def test_contradicting_deliveries_keep_one_whole(zone, paths):
    """Every second value differs in turn up and down: sorted row by row it was a patchwork of both."""
    turn = itertools.cycle((-2.0, 2.0))
    zigzag = column("hx_out_degc", lambda v: v + next(turn))
    for path in paths:
        zone.deliver(path, zigzag if path == COPY else lambda c: c)
        zone.night()
    rows = zone.night()
    assert (rows.height, of_one_file(rows)) == (N, CSV)
    aside = zone.quarantine.filter(reason="conflicting_delivery")
    assert set(aside["file"]) == {COPY}
    assert aside.height == aside["n_rows"].sum() == N
    assert aside["detail"].str.contains(CSV, literal=True).all()
    assert aside["content"].str.contains("hx_out_k").all()


def test_delivery_with_more_rows_wins(zone):
    zone.deliver(CSV, head(20))
    zone.deliver(COPY, warmer)
    rows = zone.night()
    assert (rows.height, of_one_file(rows)) == (N, COPY)
    assert zone.quarantine.filter(reason="conflicting_delivery")["file"].to_list() == [CSV] * 20


def test_rows_beyond_winner_stay_aside(zone):
    zone.deliver(CSV, head(30))
    zone.deliver(COPY, both(warmer, lambda c: joined([fields_of(c)[0], *fields_of(c)[-25:]])))
    assert of_one_file(zone.night()) == CSV
    aside = zone.quarantine.filter(reason="conflicting_delivery")
    assert (aside.height, set(aside["file"])) == (25, {COPY})
    assert aside.filter(pl.col("detail").str.contains("does not hold this row")).height == N - 30


def test_agreeing_deliveries_complete_each_other(zone):
    zone.deliver(CSV, head(30))
    zone.deliver(COPY, lambda c: joined([fields_of(c)[0], *fields_of(c)[-25:]]))
    assert zone.night().height == N
    assert zone.reasons() == ["flight_id_from_column"]


def test_second_leg_in_other_file_is_noted(zone):
    zone.deliver(CSV)
    zone.deliver(COPY, both(warmer, retimed(lambda time: time.replace("-25T", "-26T"))))
    for _ in range(2):
        assert zone.night().height == 2 * N
        assert zone.reasons() == ["flight_id_from_column", "two_legs"]


def test_note_of_vanished_file_stands_once(zone):
    zone.deliver(CSV)
    zone.deliver(COPY, both(warmer, retimed(lambda time: time.replace("-25T", "-26T"))))
    zone.night()
    (zone.landing / COPY).unlink()
    zone.night()
    assert zone.quarantine.filter(reason="two_legs").height == 1


@pytest.mark.parametrize("paths", [(CSV, COPY), (COPY, CSV)])
def test_copy_at_other_times_is_one(zone, paths):
    for path in paths:
        zone.deliver(path, an_hour_later if path == COPY else lambda c: c)
        rows = zone.night()
    assert (rows.height, of_one_file(rows)) == (N, CSV)
    assert zone.quarantine.filter(reason="conflicting_delivery")["file"].to_list() == [COPY] * N


def test_copy_of_vanished_file_is_seen(zone, good_rows):
    (zone.landing / CSV).unlink()
    zone.deliver(COPY, an_hour_later)
    for _ in range(2):
        assert zone.night().equals(good_rows)


def test_vanished_winner_still_wins(zone, good_rows):
    (zone.landing / CSV).unlink()
    zone.deliver(COPY, both(warmer, head(40)))
    assert of_one_file(zone.night()) == CSV
    assert of_one_file(zone.night()) == CSV


def test_vanished_loser_is_still_noted(zone):
    zone.deliver(CSV, head(20))
    zone.night()
    (zone.landing / CSV).unlink()
    zone.deliver(COPY, warmer)
    for _ in range(2):
        assert of_one_file(zone.night()) == COPY
        assert zone.quarantine.filter(reason="conflicting_delivery")["file"].to_list() == [CSV] * 20


def test_shorter_file_loses_no_row(zone, good_rows):
    zone.deliver(CSV, head(20))
    for _ in range(2):  # also when the flight is made again later
        assert zone.night().equals(good_rows)
        (note,) = zone.quarantine.rows(named=True)
        assert (note["reason"], note["scope"], note["file"]) == ("fewer_rows", "note", CSV)
        assert set(re.findall(r"\d+", note["detail"])) == {"42", "20"}
    zone.deliver(CSV)
    assert zone.night().equals(good_rows)
    assert zone.reasons() == []


def test_shorter_correction_replaces_the_flight(zone, good_rows):
    zone.deliver(CSV, both(warmer, head(20)))
    for _ in range(2):
        assert zone.night().height == 20
        assert zone.reasons() == ["fewer_rows", "replaced_row"]
        assert zone.quarantine.filter(reason="replaced_row")["n_rows"].sum() == N - 20
    zone.deliver(CSV, warmer)
    assert zone.night().height == N
    assert zone.reasons() == []


def test_retimed_file_replaces_the_flight(zone, good_rows):
    zone.deliver(CSV, both(an_hour_later, head(20)))
    for _ in range(2):
        assert zone.night()["time_utc"].min() == good_rows["time_utc"].min() + timedelta(hours=1)
        assert zone.quarantine.filter(reason="replaced_row")["n_rows"].sum() == N


def test_correction_replaces_the_flight(zone, good_rows):
    zone.deliver(CSV, warmer)
    after = zone.night()
    assert (after["hx_out_k"] - good_rows["hx_out_k"]).round(3).unique().to_list() == [2.0]
    assert zone.reasons() == []


def test_refused_row_is_not_fewer(zone, good_rows):
    zone.deliver(CSV, field(3, "pack", b"9"))
    assert zone.night().height == N - 1
    assert zone.reasons() == ["bad_pack"]


def note_night(zone: Zone, year: int) -> None:
    zone.ledger.note_night((f"{year}-01-01T00:00:00+00:00", "", 1, 1, 1, 1, "{}"))


def change_stealthily(zone: Zone) -> None:
    """Change a value of the file, at the same size and time."""
    stat = (zone.landing / CSV).stat()
    zone.deliver(CSV, lambda c: c.replace(b",CL,", b",DS,", 1))
    assert (zone.landing / CSV).stat().st_size == stat.st_size
    os.utime(zone.landing / CSV, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def test_stealthy_change_is_noticed(zone, good_rows):
    assert {record.touched_ns for record in zone.ledger.file_records().values()} == {None}, "touched just before it"
    note_night(zone, 2026)
    change_stealthily(zone)
    assert zone.new_paths == [CSV]
    assert zone.night()["phase_code"].to_list() != good_rows["phase_code"].to_list()
    assert zone.new_paths == []


@pytest.fixture
def read_at_leisure(monkeypatch):
    """Every file counts as read long after it was touched."""
    monkeypatch.setattr(scan_module, "TICK_NS", -60 * 10**9)


@pytest.mark.usefixtures("read_at_leisure")
def test_standing_change_time_spares_reading(zone, good_rows, monkeypatch):
    with monkeypatch.context() as within:
        within.setattr(scan_module, "_digest", None)
        assert zone.new_paths == []
    before = zone.ledger.file_records()
    (zone.landing / CSV).chmod(0o600)
    assert zone.night().height == N
    assert zone.ledger.file_records()[CSV].touched_ns > before[CSV].touched_ns


@pytest.mark.usefixtures("read_at_leisure")
def test_change_time_outdoes_the_clock(zone, good_rows):
    note_night(zone, 2100)
    change_stealthily(zone)
    assert zone.new_paths == [CSV]


def cut(landing: Path) -> None:
    content = (landing / CSV).read_bytes()
    (landing / CSV).write_bytes(content[: len(content) // 2])


def put_folder_in_place(landing: Path) -> None:
    (landing / CSV).unlink()
    (landing / CSV).mkdir()


def put_pipe_in_place(landing: Path) -> None:
    (landing / CSV).unlink()
    os.mkfifo(landing / CSV)


def put_dead_link_in_place(landing: Path) -> None:
    (landing / CSV).unlink()
    (landing / CSV).symlink_to("nowhere")


def unmount(landing: Path) -> None:
    shutil.rmtree(landing)
    landing.mkdir()


BAD_MOMENTS = [cut, put_folder_in_place, put_pipe_in_place, put_dead_link_in_place, unmount]


@pytest.mark.parametrize("meanwhile", BAD_MOMENTS)
def test_misread_file_is_new_again(zone, meanwhile):
    zone.deliver(CSV)
    stat = (zone.landing / CSV).stat()
    zone.night(meanwhile)

    unmount(zone.landing)
    zone.deliver(CSV)
    os.utime(zone.landing / CSV, ns=(stat.st_atime_ns, stat.st_mtime_ns))

    assert zone.new_paths == [CSV]


def test_file_that_changed_is_noted(zone):
    zone.deliver(CSV)

    zone.night(lambda landing: zone.deliver(CSV, field(3, "phase_code", b"DS")))

    assert zone.reasons() == ["changed_since_scan"]


def test_unopened_file_makes_no_run(zone, monkeypatch):
    zone.deliver(CSV)
    monkeypatch.setattr(scan_module, "_hash_file", fail_to_open)

    zone.night()

    assert zone.new_paths == []


def fail_to_open(path: Path) -> str:
    raise OSError(5, "Input/output error")


def test_unopened_file_is_new_later(zone, monkeypatch):
    zone.deliver(CSV)
    with monkeypatch.context() as within:
        within.setattr(scan_module, "_hash_file", fail_to_open)
        zone.night()

    assert zone.new_paths == [CSV]


def test_files_before_night_stay_unread(zone, good_rows, monkeypatch):
    note_night(zone, 2100)
    monkeypatch.setattr("pipelines.intake.scan._digest", None)
    assert zone.new_paths == []
