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


def test_parameters_equal_independent_decoder(a330):
    reference = theirs("decoded_717.parquet")
    assert len(reference) == 426
    assert disagreements(a330, {n: f for n, f in reference.items() if n not in LISTED_TWICE}) == []
    for name in LISTED_TWICE:
        both = reference[name].select("t_s", "value").rows()
        assert set(zip(a330[name].t_s, a330[name].value, strict=True)) <= set(both)
    reference = theirs("decoded_767.parquet")
    b787 = read("b787.vec", "b787_767.zip")
    assert (len(reference), len(b787)) == (130, 2718)
    assert disagreements(b787, reference) == []


def test_printed_reports_are_read_whole(a330):
    """And they say what the recording says: one flight, one pair of engines."""
    reports = read_reports(members("a330_717.wgl.zip")["message.dat"], A330)
    assert reports.rejected == ()
    assert {line.number for line in reports.lines} == {"08", "10", "13", "15", "18", "37", "50"} == set(A330)
    assert len(reports.lines) == 224
    assert len(reports.undeclared) == 5  # doors, taxi, push back
    heads = [line.values for line in reports.lines if line.row == "C1"]
    assert {head["flight"] for head in heads} == {"CAA8765"}
    assert {head["from"] for head in heads} == {"ZJHK", None}
    engines = {line.values["esn"] for line in reports.lines if "esn" in line.values}
    assert engines == {"735177", "735125", "000000"}
    # packs off at engine start
    packs = [line.values for line in reports.lines if line.row == "C3" and line.number == "10"]
    assert {(p["pack_flow_1"] < 0.1, p["crossfeed"], p["apu"]) for p in packs} == {(True, 1.0, "1")}


def test_arinc_647a_examples_are_read():
    """Every kind of element of the standard; what its words leave to a person is told."""
    examples = {n: read_xml(text) for n, text in members("arinc_647a_1.zip").items() if n.endswith(".xml")}
    (frame_767,), (frame_717,) = ([m for m in examples.values() if isinstance(m, kind)] for kind in (Map767, Map717))
    assert frame_717.words == 64
    assert frame_717.subframe_s == 60 / 61
    assert set(frame_717.parameters) >= {"Altitude Press-L", "Time UTC-Min", "Rudder Ped Pos", "Radio Altitude"}
    minutes = frame_717.parameters["Time UTC-Min"]
    assert (minutes.cycle, [s.pieces[0].frame for s in minutes.samples]) == (16, [1, 9])
    assert len(frame_717.parameters["Radio Altitude"].samples) == 2
    assert len(frame_717.parameters["Control Column Position"].samples) == 16
    unreadable = {n: p.unreadable for n, p in frame_717.parameters.items() if p.unreadable}
    assert set(unreadable) == {"Rudder Ped Pos", "Lateral Range"}
    rates = {"1 Hz Parameters": 1.0, "Rudder Exceedance Parameters": None, "4 Hz Parameters": 4.0}
    assert [(f.title, f.rate_hz) for f in frame_767.frames.values()] == [*rates.items()]
    assert frame_767.frames[3].size == 12 + 3  # two of 12 bits


def test_whole_values_agree_with_reports(a330):
    """Beside the values as listed: the flight, the airport and the position that the printed reports have too."""

    def texts(name: str) -> set[str]:
        series = a330[name]
        return {series.text.names[c] for c in series.text.codes[series.valid]}

    assert texts("CITY_FROM_R.whole") == {"ZJHK"}
    assert {c[:4] for c in texts("FNO_P5678.whole")} == {"765 "}
    latitude = a330["LATPGPS.whole"].value
    longitude = a330["LONGPGPS.whole"].value
    assert 19.8 < latitude.min() < latitude.max() < 20.4  # north of Haikou
    assert 110.3 < longitude.min() < longitude.max() < 110.7
    assert np.abs(np.diff(latitude)).max() < 0.01
    assert np.abs(a330["LATG.whole"].value).max() < 0.1  # of the lateral acceleration's 4 g as listed
    assert 300_000 < a330["GW.whole"].value[0] < 340_000
