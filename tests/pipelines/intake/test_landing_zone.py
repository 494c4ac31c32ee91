"""What is found in the landing zone, and what is refused: hostile names, links, pipes."""

import os
import time
from datetime import date

import pytest

from pipelines.intake.landing import list_landing
from pipelines.intake.landing_file import flight_day, flight_of_file, is_operator, is_tail
from pipelines.intake.snapshots import flights_in

GOOD = {
    "fleet.csv": ("", "", "fleet"),
    "AQX/LX-AAA/messages.csv": ("AQX", "LX-AAA", "messages"),
    "AQX/LX-AAA/maintenance.csv": ("AQX", "LX-AAA", "maintenance"),
    "AQX/LX-AAA/acms/LX-AAA_20240525_04.csv": ("AQX", "LX-AAA", "acms"),
    "AQX/LX-AAA/acms/history_2024-05.parquet": ("AQX", "LX-AAA", "history"),
    "AQX/LX-AAA/cpl/LX-AAA_20240525_04.parquet": ("AQX", "LX-AAA", "cpl"),
    "BZR/A9-BAB/acms/odd name (1).csv": ("BZR", "A9-BAB", "acms"),
    "BZR/A9-BAB/acms/history_2024-05 (1).PARQUET": ("BZR", "A9-BAB", "history"),
}
UNLIKE = (("acms", "xlsx"), ("acms", "csv.gz"), ("cpl", "csv"))
STRAY = [
    "readme.txt",
    "AQX/notes.csv",
    *(f"{folder}/LX-AAA_20240525_04.csv" for folder in ("aqx/LX-AAA/acms", "AQX/lx_aaa/acms", "AQX/LX-AAA/acsm")),
    *(f"AQX/LX-AAA/{folder}/LX-AAA_20240525_04.{kind}" for folder, kind in UNLIKE),
    "AQX/LX-AAA/acms/line\nbreak.csv",
    "AQX/LX-AAA/acms/\udcff.csv",
]


def put(root, name, content=b"x"):
    path = os.path.join(root, name)
    os.makedirs(os.path.dirname(path), exist_ok=True)
    with open(path, "wb") as sink:
        sink.write(content)


@pytest.fixture
def landing(tmp_path):
    """A landing zone with a file of each kind."""
    for name in GOOD:
        put(tmp_path, name)
    return list_landing(tmp_path)


def test_contract_files_have_their_aircraft(landing):
    assert {f.path: (f.operator, f.tail, f.kind) for f in landing.files} == GOOD
    assert landing.quarantine.is_empty()


def test_files_have_their_properties(landing):
    assert all(f.size == 1 and f.mtime_ns > 0 for f in landing.files)
    assert all(f.is_text == (f.kind not in ("history", "cpl")) for f in landing.files)
    assert all((f.source == "cpl") == (f.kind == "cpl") for f in landing.files)


@pytest.mark.parametrize("name", STRAY, ids=ascii)
def test_stray_file_is_refused_alone(tmp_path, name):
    put(tmp_path, "AQX/LX-AAA/acms/LX-AAA_20240525_04.csv")
    put(tmp_path, name)
    landing = list_landing(tmp_path)
    assert [f.path for f in landing.files] == ["AQX/LX-AAA/acms/LX-AAA_20240525_04.csv"]
    assert landing.quarantine["reason"].to_list() == ["unexpected_name"]
    assert landing.quarantine["file"].item().isprintable()
    landing.quarantine["file"].item().encode()


UNFINISHED = ["LX-AAA_20240525_04.csv.part", "x.7f3a.partial", "a.part", ".x.csv.123.part"]


@pytest.mark.parametrize("name", [*(f"AQX/LX-AAA/acms/{name}" for name in UNFINISHED), "AQX.part", ".DS_Store"])
def test_unfinished_file_is_left_alone(tmp_path, name):
    put(tmp_path, name)
    landing = list_landing(tmp_path)
    assert not landing.files
    assert landing.quarantine.is_empty()


@pytest.mark.parametrize("name", ["history_2024-05.part1.parquet", "LX-AAA_20240525_04.part.csv", "a.party.csv"])
def test_part_within_a_name_is_read(tmp_path, name):
    put(tmp_path, f"AQX/LX-AAA/acms/{name}")

    assert [f.name for f in list_landing(tmp_path).files] == [name]


@pytest.mark.parametrize("name", ["x.csv.part1", "x.part.bak"])
def test_part_of_unknown_form_is_refused(tmp_path, name):
    put(tmp_path, f"AQX/LX-AAA/acms/{name}")

    assert list_landing(tmp_path).quarantine["reason"].to_list() == ["unexpected_name"]


@pytest.mark.parametrize(
    "linked", ["AQX/LX-AAA/acms/LX-AAA_20240525_04.csv", "AQX/LX-AAA/acms", "AQX/LX-AAA", "AQX", "fleet.csv"]
)
def test_outside_link_is_refused(tmp_path, linked):
    outside = tmp_path / "outside"
    zone = tmp_path / "zone"
    put(outside, "secret.csv", b"secret")
    os.makedirs((zone / linked).parent)
    os.symlink(outside / "secret.csv" if linked.endswith(".csv") else outside, zone / linked)
    landing = list_landing(zone)
    assert not landing.files
    assert landing.quarantine["reason"].to_list() == ["outside_landing"]


def test_inside_link_is_followed(tmp_path):
    put(tmp_path, "AQX/LX-AAA/acms/LX-AAA_20240525_04.csv")
    os.symlink("LX-AAA_20240525_04.csv", tmp_path / "AQX/LX-AAA/acms/LX-AAA_20240525_05.csv")
    landing = list_landing(tmp_path)
    assert (len(landing.files), landing.quarantine.height) == (2, 0)


@pytest.mark.parametrize(
    ("make", "name", "reason"),
    [
        (lambda path: path.symlink_to("nowhere"), "acms/LX-AAA_20240525_06.csv", "outside_landing"),
        (os.mkfifo, "acms/LX-AAA_20240525_07.csv", "not_a_file"),
        (os.mkdir, "acms/LX-AAA_20240525_08.csv", "unexpected_name"),
        (os.mkdir, "messages.csv", "unexpected_name"),
    ],
    ids=["dead link", "pipe", "folder of a flight", "folder of messages"],
)
def test_special_file_is_refused_alone(tmp_path, make, name, reason):
    put(tmp_path, "AQX/LX-AAA/acms/LX-AAA_20240525_04.csv")
    make(tmp_path / "AQX/LX-AAA" / name)
    landing = list_landing(tmp_path)
    assert len(landing.files) == 1
    assert landing.quarantine.select("file", "reason").rows() == [(f"AQX/LX-AAA/{name}", reason)]


def test_missing_zone_is_reported(tmp_path):
    assert list_landing(tmp_path / "none").quarantine["reason"].to_list() == ["cannot_open"]


def test_listing_takes_linear_time(tmp_path):
    folder = tmp_path / "AQX/LX-AAA/acms"
    folder.mkdir(parents=True)
    for i in range(5_000):
        (folder / f"LX-AAA_{20200101 + i // 99}_{i % 99 + 1:02d}.csv").touch()
    started = time.process_time()
    assert sum(entry.stat().st_size == 0 for entry in os.scandir(folder)) == 5_000
    listing_s = time.process_time() - started
    assert len(list_landing(tmp_path).files) == 5_000
    assert time.process_time() - started < 40.0 * listing_s  # some six times a look at each: 100,000 files in a second


def test_name_or_column_gives_flights(good_flight, deliver):
    expected = {
        "LX-AAA_20240101_01.csv": (b"", ["LX-AAA_20240101_01"]),
        "odd.csv": (good_flight, ["LX-AAA_20240525_04"]),
        "bad.csv": (good_flight.replace(b"LX-AAA_", b"../../"), []),
        "history_2024-05.parquet": (b"broken", []),
    }
    files = deliver({f"AQX/LX-AAA/acms/{name}": content for name, (content, _) in expected.items()})
    assert {f.name: flights_in(f) for f in files} == {name: flights for name, (_, flights) in expected.items()}


@pytest.mark.parametrize(
    "bad",
    [
        "",
        "LX-AAA",
        "LX-AAA_20240230_01",
        "LX-AAA_20240101_00",
        "LX-AAA_20240101_1",
        "lx-aaa_20240101_01",
        "LX-AAA_20240101_01\n",
        "../../../X_20240101_01",
        "LX AAA_20240101_01",
        "ＬＸ_20240101_01",
        "LX-AAA_２０240101_01",
        "A_20240101_01",
    ],
)
def test_bad_flight_id_has_no_day(bad):
    assert flight_day(bad) is None


def test_flight_id_has_its_day():
    assert flight_day("LX-AAA_20240229_01") == date(2024, 2, 29)


@pytest.mark.parametrize(("tail", "flight"), [("LX-AAA", "LX-AAA_20240229_01"), ("LX-AAB", None)])
def test_file_names_flight_of_tail(tail, flight):
    assert flight_of_file("LX-AAA_20240229_01.csv", tail) == flight


def test_operator_code_has_a_pattern():
    good = ["AQX", "AQ", "AQ1", "NORDIC", "FLEET787"]
    assert [n for n in (*good, "AQX\n", "../", "A", "1AQ", "aqx", "AQ-X", "FLEET7871", "") if is_operator(n)] == good


def test_tail_has_a_pattern():
    assert [n for n in ("LX-AAA", "..", "LX/AAA", "LX-AAA\n", "X") if is_tail(n)] == ["LX-AAA"]
