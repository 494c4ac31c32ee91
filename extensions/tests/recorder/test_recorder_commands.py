"""`hdt recorder`: from a recording's file and a map's to a table, and to one line where they do not go together."""

import json
import zipfile

import numpy as np
import polars as pl
import pytest
from command import hdt
from recordings import DATA, DEMO_717, DEMO_767, frames_717, frames_767, message_file, pack, random_raw, raw_767

from hdt_recorder import printed_reports, recorder_rows, recordings
from hdt_recorder.decoding.coding import PACKINGS

MAP_717 = DATA / "demo_717.toml"
MAP_767 = DATA / "demo_767.toml"
MAP_XML = DATA / "demo_717.xml"


def recorder(*words: object) -> str:
    """What the command prints where it ends well."""
    done = hdt("recorder", *words)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def recording(tmp_path):
    raw = random_raw(DEMO_717, np.random.default_rng(1), 48)
    for name in ("ALTITUDE", "PACK_TEMP"):
        raw[name] %= 400
    words = frames_717(DEMO_717, raw, first_count=0)
    words[7, 64] ^= 1  # the second sync word of the eighth frame
    path = tmp_path / "flight.dat"
    path.write_bytes(pack(words, PACKINGS[2]))
    return path, raw


def test_recording_becomes_table(recording, tmp_path):
    path, raw = recording
    target = tmp_path / "flight.parquet"
    printed = recorder("decode", path, "--map", MAP_717, "--out", target)
    assert "11 parameters" in printed
    assert "Subframes: 190 whole, 2 damaged, 0 missing" in printed
    rows = pl.read_parquet(target)
    assert rows.schema == {"parameter": pl.String, "t_s": pl.Float64, "value": pl.Float64, "text": pl.String}
    assert rows["value"].is_finite().all()  # null is null, not NaN
    temperature = rows.filter(parameter="PACK_TEMP")
    expected = pl.Series(0.25 * raw["PACK_TEMP"] + 1.5).scatter([28, 29], None)
    assert temperature["value"].to_list() == expected.to_list()
    valve = rows.filter(parameter="VALVE")
    assert valve["text"].to_list()[:2] == [("CLOSED", "OPEN")[int(r)] for r in raw["VALVE"][:2]]
    assert rows.filter(parameter="CITY")["value"].null_count() == 3


def test_only_named_parameters_are_decoded(recording, tmp_path):
    target = tmp_path / "two.parquet"
    words = ("--parameter", "PITCH", "--parameter", "MODE", "--out", target)
    recorder("decode", recording[0], "--map", DATA / "demo_717.csv", *words)
    assert pl.read_parquet(target)["parameter"].unique(maintain_order=True).to_list() == ["PITCH", "MODE"]


def test_archive_is_read_by_largest_file(recording, tmp_path):
    archive = tmp_path / "flight.zip"
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("log.txt", "short")
        file.write(recording[0], "raw.dat")
    printed = recorder("list", archive, "--map", MAP_XML)
    assert "no value: its conversion is told in words: Teledyne Synchro" in printed
    assert "ALTITUDE" in printed


def test_recording_contents_are_listed(tmp_path):
    path = tmp_path / "flight.767"
    path.write_bytes(frames_767(DEMO_767, raw_767(5)))
    listing = json.loads(recorder("list", path, "--map", MAP_767, "--json"))
    assert listing["damage"] | {"unit": "frames", "damaged": 0, "missing": 0} == listing["damage"]
    rates = {p["parameter"]: (p["unit"], p["rate_hz"], p["kind"]) for p in listing["parameters"]}
    assert rates["OUTLET_TEMP"] == ("degC", 1.0, "binary")
    assert rates["RATE"] == ("deg/s", 5.0, "binary")
    assert rates["DIGIT"] == ("", 0.25, "bcd")


def test_printed_reports_become_table(tmp_path):
    text = "\n   A999 PACK SURVEY REPORT <91>   PAGE 01 OF 01\n\nN1 1.31 OFF\nN2 -.-- ON\nN1 1.3 OFF\n"
    (tmp_path / "message.dat").write_bytes(message_file(text))
    (tmp_path / "own.txt").write_text("<91> PACK SURVEY\nN1|N2 {flow:4} {state:s}\n")
    words = ("--layouts", tmp_path / "own.txt", "--out", tmp_path / "r.parquet")
    printed = recorder("reports", tmp_path / "message.dat", *words)
    assert "<91> PACK SURVEY: 1 reports, 2 lines" in printed
    assert "line 6: flow is '1.3', not as wide as its layout has it: N1 1.3 OFF" in printed
    rows = pl.read_parquet(tmp_path / "r.parquet")
    assert rows.filter(name="flow")["value"].to_list() == [1.31, None]
    assert rows.filter(name="state")["text"].to_list() == ["OFF", "ON"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("list", "{rec}", "--map", "{tmp}/none.toml"), "No such file"),
        (("list", "{tmp}/none.dat", "--map", MAP_717), "No such file"),
        (("list", "{rec}"), "--map"),
        (("list", "{rec}", "--map", "{rec}"), "flight.dat: "),
        (("list", "{rec}", "--map", MAP_767), "demo_767.toml does not fit flight.dat: no ARINC 767 frame"),
        (("list", "{rec}", "--map", "{tmp}/wide.toml"), "the recording has 64 words a second, the map 128"),
        (("list", "{tmp}/empty.dat", "--map", MAP_717), "no ARINC 717 frame in 0 bytes"),
        (("list", "{tmp}/broken.zip", "--map", MAP_717), "broken.zip"),
        (("reports", "{rec}", "--layouts", MAP_717), "line 1: a report begins with <nn>"),
        (("decode", "{rec}", "--map", MAP_717), "--out"),
        (("decode", "{rec}", "--map", MAP_717, "--parameter", "PTICH", "--out", "{tmp}/x"), "near are PITCH"),
        (("decode", "{rec}", "--map", MAP_XML, "--parameter", "RUDDER", "--out", "{tmp}/x"), "has no value"),
        (("decode", "{rec}", "--map", MAP_717, "--out", "{tmp}"), "is not overwritten"),
    ],
)
def test_mismatch_takes_one_line(words, message, recording, tmp_path):
    (tmp_path / "wide.toml").write_text('format = "ARINC 717"\nwords_per_second = 128\n')
    (tmp_path / "empty.dat").touch()
    with zipfile.ZipFile(tmp_path / "broken.zip", "w") as file:
        file.writestr("raw.dat", recording[0].read_bytes())
    whole = (tmp_path / "broken.zip").read_bytes()
    (tmp_path / "broken.zip").write_bytes(whole[:200] + b"xxxx" + whole[204:])
    arguments = [str(w).format(rec=recording[0], tmp=tmp_path) for w in words]
    done = hdt("recorder", *arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("words", [("reports",), ("list", "--map", MAP_717)])
def test_bloated_archive_is_refused(tmp_path, monkeypatch, words):
    monkeypatch.setattr("hdt_recorder.recordings.MOST_BYTES", 1 << 20)
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("message.dat", bytes((1 << 20) + 1))
    done = hdt("recorder", words[0], tmp_path / "bomb.zip", *words[1:])
    assert done.returncode == 2
    assert "1,048,577 bytes; 1,048,576 are allowed" in done.stderr


def test_command_shares_bound_with_night():
    assert recorder_rows.MOST_BYTES == printed_reports.MOST_BYTES == recordings.MOST_BYTES == 512 << 20


DEEP = "[" * 20_000 + "]" * 20_000


@pytest.mark.parametrize(("name", "text"), [
    ("deep.toml", f'format = "ARINC 717"\nx = {DEEP}'), ("deep.csv", f"# x = {DEEP}\nname\n"),
    ("deep.xml", "<a>" * 20_000 + "</a>" * 20_000), ("head.toml", 'format = "ARINC 717"\nwords_per_second = "x"'),
    ("head.toml", 'format = "ARINC 717"\nwords_per_second = inf'),
    ("entry.toml", 'format = "ARINC 717"\nwords_per_second = 64\nparameter = [1]'),
])  # fmt: skip
def test_broken_map_takes_one_line(recording, tmp_path, name, text):
    (tmp_path / name).write_text(text)
    done = hdt("recorder", "list", recording[0], "--map", tmp_path / name)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert done.stderr.startswith(f"hdt: {name}: ")


@pytest.mark.parametrize("member", ["a map", "a recording"])
def test_damaged_archive_takes_one_line(recording, tmp_path, member):
    name = "x.par" if member == "a map" else "flight.dat"
    with zipfile.ZipFile(tmp_path / "bad.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, bytes(range(256)) * 64)
    damaged = bytearray((tmp_path / "bad.zip").read_bytes())
    damaged[60:90] = bytes(30)
    (tmp_path / "bad.zip").write_bytes(damaged)
    files = (recording[0], tmp_path / "bad.zip") if member == "a map" else (tmp_path / "bad.zip", MAP_717)
    done = hdt("recorder", "list", files[0], "--map", files[1])
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "bad.zip: " in done.stderr
