"""What is not taken in does not go by without a word: names, rows set aside, columns that fell silent."""

import os
from pathlib import Path

import duckdb
import polars as pl
import pytest
from nights import empty_home
from small_catalog import catalog
from soundness import faults
from spoils import Spoil, column, field

from pipelines.cli.base import app
from pipelines.cli.doctor import FILES_A_FOLDER, Check, examine, sample_files
from pipelines.digest.changes import EMPTY, compare, read_state
from pipelines.digest.render import as_text
from pipelines.intake.faults import (
    MAX_LINES,
    file_lines,
    ignored_entries,
    quarantine_line,
    silent_columns,
    silent_lines,
)
from pipelines.intake.ingest import ingest_flights
from pipelines.intake.landing import list_landing
from pipelines.intake.scan import scan
from pipelines.orchestration.nightly import Night
from pipelines.storage.catalog import connect
from pipelines.storage.ledger import Ledger
from pipelines.storage.publication import publish
from pipelines.storage.store import Store

GOOD = Path(__file__).parents[1] / "data/dirty/landing/AQX/LX-AAA/acms/LX-AAA_20240525_04.csv"
KNOTS = column("mach", lambda mach: round(mach * 600.0, 1))
LATE = column("pack", lambda pack: 5)
as_it_is = bytes


def drop(landing: Path, spoils: list[Spoil]) -> None:
    """A flight a spoil, of legs 01, 02 ... of a day."""
    (landing / "fleet.csv").write_text("operator,tail,packs\nAQX,LX-AAA,2\n")
    (landing / "AQX/LX-AAA/acms").mkdir(parents=True, exist_ok=True)
    for leg, spoil in enumerate(spoils, 1):
        flight = f"20240525_{leg:02d}"
        content = spoil(GOOD.read_bytes()).replace(b"20240525_04", flight.encode())
        (landing / f"AQX/LX-AAA/acms/LX-AAA_{flight}.csv").write_bytes(content)


TAKEN_IN = ("raw_snapshots", "raw_deliveries", "raw_quarantine")


def night(landing: Path, home: Path) -> frozenset[str]:
    """Take in what lies there, as far as the raw stage; the files that came."""
    store = Store(home)
    ledger = Ledger(home)
    aircraft = ("AQX", "LX-AAA")
    new_paths = scan(landing, ledger).new_paths
    flights = ledger.flights_on_file()["flight_id"].to_list()
    intake = ingest_flights(landing, store, ledger, aircraft, flights)
    for table, frame in zip(TAKEN_IN, (intake.rows, intake.deliveries, intake.quarantine), strict=True):
        store.merge(table, {aircraft: flights}, frame)
    return new_paths


def read(home: Path) -> duckdb.DuckDBPyConnection:
    """The catalog of what was taken in."""
    return catalog(**{table: Store(home).read_table(table).to_dicts() for table in TAKEN_IN})


@pytest.fixture
def zone(tmp_path) -> tuple[Path, Path]:
    (tmp_path / "landing").mkdir()
    return tmp_path / "landing", empty_home(tmp_path / "home").home


def silence(zone: tuple[Path, Path], spoils: list[Spoil]) -> list[dict]:
    """Columns that are silent after a night over these flights."""
    drop(zone[0], spoils)
    night(*zone)
    with read(zone[1]) as con:
        return silent_columns(con)


def check_of(name: str, landing: Path | None, home: Path | None = None) -> Check:
    """One of the doctor's checks."""
    return next(c for c in examine(landing, home) if c.name == name)


def test_silent_column_names_likely_unit(zone):
    """On a line that catalog, digest and doctor share."""
    landing, home = zone
    drop(landing, [as_it_is, KNOTS, as_it_is, KNOTS, KNOTS])
    night(landing, home)
    publish(home)
    with connect(home) as con:
        (line,) = silent_lines(silent_columns(con))
        digest = compare(EMPTY, read_state(con))
    assert line == (
        "AQX LX-AAA: mach refused in 100 % of 84 rows since 2024-05-25 leg 04 (out of range), last in"
        " AQX/LX-AAA/acms/LX-AAA_20240525_05.csv. It fits knots."
    )
    assert f"Columns that fell silent\n- {line}" in as_text(digest)
    check = check_of("units and wiring", None, home)
    assert not check.well
    assert line in check.message


@pytest.mark.parametrize(
    ("spoils", "later"),
    [([as_it_is, KNOTS, as_it_is, KNOTS, KNOTS], as_it_is), ([as_it_is, LATE, LATE], field(7, "hx_out_degc", b"999"))],
    ids=["good flight", "spike"],
)
def test_next_flight_ends_silence(zone, spoils, later):
    assert silence(zone, spoils) != []
    assert silence(zone, [*spoils, later]) == []


def test_refused_rows_are_silence(zone):
    (row,) = silence(zone, [as_it_is, LATE, LATE])
    assert (row["column_name"], row["reason"], row["n_files"], row["n_refused"]) == ("pack", "bad_pack", 2, 84)


def test_night_counts_refused_rows(zone):
    """Of which file, and why."""
    landing, home = zone
    drop(landing, [as_it_is, LATE])
    new_paths = night(landing, home)
    with read(home) as con:
        line = quarantine_line(con, new_paths)
        assert quarantine_line(con, frozenset()) == ""
    assert line.startswith(
        "42 rows of 1 file, most of them of AQX/LX-AAA/acms/LX-AAA_20240525_02.csv (42): pack is not"
    )
    assert 'hdt query "select * from quarantine where n_rows > 0"' in line


@pytest.mark.parametrize("name", ["contents", "landing zone"])
def test_doctor_passes_good_files(zone, name):
    drop(zone[0], [as_it_is] * 4)
    check = check_of(name, zone[0])
    assert check.well, check.message


def test_doctor_judges_contents(zone):
    drop(zone[0], [as_it_is] * 4 + [KNOTS])
    check = check_of("contents", zone[0])
    assert not check.well
    assert "mach refused in 100 % of 42 rows since 2024-05-25 leg 05" in check.message
    assert "It fits knots." in check.message


def test_doctor_samples_each_folder(zone):
    """The oldest file and the newest."""
    drop(zone[0], [as_it_is] * 6)
    legs = [file.path[-6:-4] for file in sample_files(list_landing(zone[0]).files)]
    assert (len(legs), legs) == (FILES_A_FOLDER, ["01", "05", "06"])


@pytest.fixture
def stray_zone(zone) -> Path:
    """A landing zone with names that fit nothing."""
    landing = zone[0]
    drop(landing, [as_it_is])
    for name in ("AQXLONGNAME", "aqx", "AQX/lx-aaa"):
        (landing / name).mkdir()
    for n in range(5):
        (landing / f"AQX/LX-AAA/acms/note_{n}.txt").write_text("x")
    return landing


def test_stray_names_share_lines(stray_zone):
    lines = {line.split(":")[0]: line for line in ignored_entries(list_landing(stray_zone).quarantine)}
    notes = ", ".join(f"AQX/LX-AAA/acms/note_{n}.txt" for n in range(3))
    assert set(lines) == {f"{notes} and 2 more", "AQX/lx-aaa", "AQXLONGNAME, aqx"}
    assert "2 to 8 capitals and digits, first a letter" in lines["AQXLONGNAME, aqx"]


def test_doctor_names_stray_folder(stray_zone):
    check = check_of("landing zone", stray_zone)
    assert not check.well
    assert "AQX/lx-aaa" in check.message


def test_stray_lines_have_a_limit():
    many = pl.DataFrame({"file": [f"F{n}" for n in range(9)], "detail": [f"so {n}" for n in range(9)]})
    assert len(ignored_entries(many)) == MAX_LINES + 1


def test_resumed_night_keeps_both_halves():
    first = Night(3, 2, 1, 4, {"AAA": "damage"}, ("a",), ("old",), frozenset({"p"}))
    both = first.combine(Night(3, 1, 2, 5, {}, ("b",), ("name",), frozenset({"q"})))
    assert (both.files, both.new_files, both.runs, both.cells, both.failed) == (3, 3, 3, 9, {})
    assert (both.repairs, both.ignored_names, both.new_paths) == (("a", "b"), ("name",), {"p", "q"})


def test_terminal_names_refused_input(zone, capfd):
    """Through the command itself: what a night hands over to who prints it is not lost on the way."""
    landing, home = zone
    drop(landing, [as_it_is, KNOTS, KNOTS, KNOTS])
    (landing / "AQX" / "odd.txt").write_text("")
    app(["nightly", "--landing", str(landing), "--home", str(home)], standalone_mode=False)
    stderr = capfd.readouterr().err
    assert "silent: AQX LX-AAA: mach refused in 100 %" in stderr
    assert "not read: AQX/odd.txt" in stderr
    assert faults(home, landing) == []


def nothing(content: bytes) -> bytes:
    return b""


def local_times(content: bytes) -> bytes:
    return content.replace(b"Z,", b",")


@pytest.mark.parametrize(("spoil", "notes", "words"), [
    (nothing, False, "The file is empty."), (LATE, False, "pack is not the number"), (local_times, True, "no zone"),
])  # fmt: skip
def test_file_is_named_with_its_fault(zone, spoil, notes, words):
    landing, home = zone
    drop(landing, [as_it_is, spoil])
    new_paths = night(landing, home)

    with read(home) as con:
        (line,) = file_lines(con, new_paths, notes=notes)

    assert line.startswith("AQX/LX-AAA/acms/LX-AAA_20240525_02.csv: ")
    assert words in line


def test_digest_names_files_with_a_note(zone):
    landing, home = zone
    drop(landing, [local_times])
    night(landing, home)
    publish(home)

    with connect(home) as con:
        digest = compare(EMPTY, read_state(con))

    assert "LX-AAA_20240525_01.csv: time without zone." in as_text(digest)


def test_doctor_reads_every_new_file(zone):
    landing, _ = zone
    drop(landing, [as_it_is, as_it_is, nothing, as_it_is, as_it_is, as_it_is])

    check = check_of("contents", landing)

    assert check.message == "AQX/LX-AAA/acms/LX-AAA_20240525_03.csv: The file is empty."


def test_doctor_names_unlisted_aircraft(zone):
    landing, _ = zone
    drop(landing, [as_it_is])
    (landing / "fleet.csv").write_text("operator,tail,packs\nAQX,LX-AAB,2\n")

    check = check_of("fleet list", landing)

    assert check.message == "fleet.csv lacks AQX LX-AAA"


def test_absurd_file_time_is_refused(zone):
    landing, home = zone
    drop(landing, [as_it_is, as_it_is])
    far = landing / "AQX/LX-AAA/acms/LX-AAA_20240525_02.csv"
    os.utime(far, ns=(0, 2**63))

    listing = scan(landing, Ledger(home))

    assert listing.quarantine.select("file", "reason").rows() == [(str(far.relative_to(landing)), "bad_file_time")]
    assert listing.flights == 1
