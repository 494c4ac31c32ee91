"""Real recordings, held against what an independent decoder reads, sample by sample.

The files are not ours to ship: the tests look for them where `HDT_REFERENCE` says, or beside the project, and skip
where they are not.
"""

import os
import zipfile
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from hdt_recorder.decoding.fit import decode, recognise
from hdt_recorder.decoding.layout import Map717, Map767
from hdt_recorder.decoding.printed import read_reports
from hdt_recorder.decoding.report_layouts import A330
from hdt_recorder.decoding.vec_map import read_vec
from hdt_recorder.decoding.xml_map import read_xml

ROOT = Path(__file__).parents[4]
REFERENCE = Path(os.environ.get("HDT_REFERENCE", ROOT.parent / "shared/reference")) / "recorder_787_a330"
pytestmark = pytest.mark.skipif(not REFERENCE.is_dir(), reason=f"no real recordings in {REFERENCE}: set HDT_REFERENCE")

LISTED_TWICE = {"CMC_FAIL"}
"""The map lists it for every frame and in a superframe; we keep the two apart, the independent decoder does not."""


def members(name: str) -> dict[str, bytes]:
    with zipfile.ZipFile(REFERENCE / name) as archive:
        return {n: archive.read(n) for n in archive.namelist()}


def read(map_file: str, archive: str) -> dict:
    layout = read_vec(members(map_file))
    data = max(members(archive).values(), key=len)
    recording = recognise(np.frombuffer(data, np.uint8), layout)
    assert (recording.damage.damaged, recording.damage.missing, recording.damage.skipped_bytes) == (0, 0, 0)
    return {s.parameter.name: s for s in decode(recording, layout.parameters.values())}


@pytest.fixture(scope="module")
def a330() -> dict:
    return read("a330.vec", "a330_717.wgl.zip")


def theirs(name: str) -> dict[str, pl.DataFrame]:
    return {str(k[0]): f for k, f in pl.read_parquet(REFERENCE / name).partition_by("parameter", as_dict=True).items()}


def disagreements(ours: dict, reference: dict[str, pl.DataFrame]) -> list[str]:
    lines = []
    for name, frame in reference.items():
        series = ours[name]
        if series.t_s.size != frame.height or not np.allclose(series.t_s, frame["t_s"], atol=1e-6):
            lines.append(f"{name}: other times")
        elif frame["value"].null_count() == frame.height:
            text = [series.text.names[c] for c in series.text.codes]
            # a character of a frame that is not in the file is null here, and a zero there
            texts = zip(text, frame["text"], series.valid, strict=True)
            lines += [] if all(a == b for a, b, k in texts if k) else [f"{name}: text"]
        elif not (series.valid.all() and np.array_equal(series.value, frame["value"])):
            lines.append(f"{name}: values")
    return lines


def test_717_parameters_equal_independent_decoder(a330):
    reference = theirs("decoded_717.parquet")
    assert len(reference) == 426
    assert disagreements(a330, {n: f for n, f in reference.items() if n not in LISTED_TWICE}) == []
    for name in LISTED_TWICE:
        both = reference[name].select("t_s", "value").rows()
        assert set(zip(a330[name].t_s, a330[name].value, strict=True)) <= set(both)


def test_767_parameters_equal_independent_decoder():
    reference = theirs("decoded_767.parquet")
    b787 = read("b787.vec", "b787_767.zip")
    assert (len(reference), len(b787)) == (130, 2718)
    assert disagreements(b787, reference) == []


@pytest.fixture(scope="module")
def reports():
    return read_reports(members("a330_717.wgl.zip")["message.dat"], A330)


def test_printed_reports_are_read_whole(reports):
    assert reports.rejected == ()
    assert {line.number for line in reports.lines} == {"08", "10", "13", "15", "18", "37", "50"} == set(A330)
    assert len(reports.lines) == 224
    assert len(reports.undeclared) == 5  # doors, taxi, push back


def test_printed_reports_agree_with_recording(reports):
    """One flight, one pair of engines, packs off at engine start."""
    heads = [line.values for line in reports.lines if line.row == "C1"]
    packs = [line.values for line in reports.lines if line.row == "C3" and line.number == "10"]
    assert {head["flight"] for head in heads} == {"CAA8765"}
    assert {head["from"] for head in heads} == {"ZJHK", None}
    engines = {line.values["esn"] for line in reports.lines if "esn" in line.values}
    assert engines == {"735177", "735125", "000000"}
    assert {(p["pack_flow_1"] < 0.1, p["crossfeed"], p["apu"]) for p in packs} == {(True, 1.0, "1")}


@pytest.fixture(scope="module")
def examples():
    """The maps of the standard for frames of ARINC 717 and 767, every kind of element in them."""
    maps = [read_xml(text) for n, text in members("arinc_647a_1.zip").items() if n.endswith(".xml")]
    (of_717,), (of_767,) = ([m for m in maps if isinstance(m, kind)] for kind in (Map717, Map767))
    return {717: of_717, 767: of_767}


def test_717_map_of_standard_is_read(examples):
    frame = examples[717]
    assert (frame.words, frame.subframe_s) == (64, 60 / 61)
    assert set(frame.parameters) >= {"Altitude Press-L", "Time UTC-Min", "Rudder Ped Pos", "Radio Altitude"}
    minutes = frame.parameters["Time UTC-Min"]
    assert (minutes.cycle, [s.pieces[0].frame for s in minutes.samples]) == (16, [1, 9])
    assert len(frame.parameters["Radio Altitude"].samples) == 2
    assert len(frame.parameters["Control Column Position"].samples) == 16


def test_unreadable_parameters_of_standard_are_named(examples):
    """Where its words leave the conversion to a person."""
    unreadable = {n for n, p in examples[717].parameters.items() if p.unreadable}
    assert unreadable == {"Rudder Ped Pos", "Lateral Range"}


def test_767_map_of_standard_is_read(examples):
    frames = examples[767].frames
    rates = {"1 Hz Parameters": 1.0, "Rudder Exceedance Parameters": None, "4 Hz Parameters": 4.0}
    assert [(f.title, f.rate_hz) for f in frames.values()] == [*rates.items()]
    assert frames[3].size == 12 + 3  # two of 12 bits


def texts(series) -> set[str]:
    return {series.text.names[c] for c in series.text.codes[series.valid]}


def test_whole_texts_agree_with_reports(a330):
    """Beside the values as listed: flight and airport that the printed reports have too."""
    assert texts(a330["CITY_FROM_R.whole"]) == {"ZJHK"}
    assert {c[:4] for c in texts(a330["FNO_P5678.whole"])} == {"765 "}


def test_whole_positions_lie_at_airport(a330):
    latitude = a330["LATPGPS.whole"].value
    longitude = a330["LONGPGPS.whole"].value
    assert 19.8 < latitude.min() < latitude.max() < 20.4  # north of Haikou
    assert 110.3 < longitude.min() < longitude.max() < 110.7
    assert np.abs(np.diff(latitude)).max() < 0.01


def test_whole_numbers_are_plausible(a330):
    assert np.abs(a330["LATG.whole"].value).max() < 0.1  # of the lateral acceleration's 4 g as listed
    assert 300_000 < a330["GW.whole"].value[0] < 340_000
