"""Files of declared components, every line accounted for; readers of packages, and a landing zone without one."""

from dataclasses import replace
from datetime import UTC, datetime
from types import ModuleType, SimpleNamespace

import polars as pl
import pytest

from hdt_core import loading
from hdt_core.components import Channel, Record
from hdt_core.components.pack import HX
from hdt_core.physics.heat_exchanger import HEAT_EXCHANGER
from pipelines.intake import components as intake
from pipelines.intake.components import read_components
from pipelines.intake.landing import list_landing
from pipelines.intake.landing_file import FileIntake, LandingFile
from pipelines.intake.readers import Reader, ReaderError, readers
from pipelines.intake.snapshots import read_snapshots

NOW = datetime(2026, 1, 1, tzinfo=UTC)
NAMES = ("hot_flow_kg_s", "ram_flow_kg_s", "hot_in_k", "cold_in_k")
CHANNELS = tuple(Channel(f"{name}_si", name, "", name, low=0.0, high=1000.0) for name in NAMES)
LINE = "{flight},2025-06-01T00:00:{second:02d}Z,1,0.9,1.6,{hot},250\n"
HEAD = "flight_id,report_time,pack,hot_flow_kg_s_si,ram_flow_kg_s_si,hot_in_k_si,cold_in_k_si\n"


@pytest.fixture
def put(tmp_path, monkeypatch):
    """Write a file of an exchanger that is declared with files of its own."""
    own = replace(HX, model=HEAT_EXCHANGER, record=Record(CHANNELS))
    monkeypatch.setattr(intake, "recorded_components", lambda: {"hx": own})

    def write(path: str, text: str) -> LandingFile:
        place = tmp_path / path
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text)
        operator, tail, *_ = path.split("/")
        return LandingFile(str(tmp_path), path, operator, tail, "component", len(text), 0)

    return write


def lines(flight: str, n: int, hot: float = 400.0) -> str:
    return HEAD + "".join(LINE.format(flight=flight, second=k, hot=hot) for k in range(n))


def read_balanced(*files: LandingFile) -> list[FileIntake]:
    """What came of each file, every line accounted for."""
    read = [d for _, d in intake.read_components(list(files), NOW)]
    assert all(d.n_delivered == d.n_loaded + int(d.quarantine["n_rows"].sum()) + d.n_duplicate for d in read)
    return read


def test_flights_named_alike_stay_apart(put):
    files = [put(f"AAA/{tail}/hx/a.csv", lines("CYCLE-0001", 5, hot)) for tail, hot in (("T1", 400), ("T2", 410))]
    read = read_balanced(*files)
    assert [d.n_loaded for d in read] == [5, 5]
    assert [d.rows.filter(signal="hot_in_k")["value"].unique().to_list() for d in read] == [[400.0], [410.0]]


def test_longer_delivery_wins(put):
    short = put("AAA/T1/hx/b.csv", lines("C1", 3, 401))
    long = put("AAA/T1/hx/a.csv", lines("C1", 6))
    read = read_balanced(long, short)
    assert [d.n_loaded for d in read] == [6, 0]
    assert read[1].quarantine["reason"].to_list() == ["conflicting_delivery"] * 3


def test_first_of_simultaneous_lines_is_stored(put):
    again = LINE.format(flight="C1", second=1, hot=410)
    (read,) = read_balanced(put("AAA/T1/hx/a.csv", lines("C1", 2) + again))
    assert read.rows.filter(signal="hot_in_k")["value"].to_list() == [400.0, 400.0]
    assert read.quarantine.select("reason", "row").rows() == [("conflicting_delivery", 4)]


def test_repeated_delivery_counts_once(put):
    files = [put(f"AAA/T1/hx/{n}.csv", lines("C1", 4)) for n in "ab"]
    assert sorted((d.n_loaded, d.n_duplicate) for d in read_balanced(*files)) == [(0, 4), (4, 0)]


def test_parquet_gives_the_same_rows(put, tmp_path):
    text = put("AAA/T1/hx/a.csv", lines("C1", 5))
    frame = pl.read_csv(tmp_path / text.path).with_columns(pl.col("report_time").str.to_datetime(time_zone="UTC"))
    frame.write_parquet(tmp_path / "AAA/T1/hx/b.parquet")
    other = replace(text, path="AAA/T1/hx/b.parquet")
    first, second = (read_balanced(f)[0] for f in (text, other))
    assert first.rows.drop("file").equals(second.rows.drop("file"))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a,b\n1,2\n", "missing_columns"),
        (HEAD.replace("report_time", "when") + "x\n", "missing_columns"),
        ("", "empty_file"),
        (lines("C1", 1).replace("2025", "2099"), "future_time"),
        (lines("C1", 1).replace("2025", "1970"), "too_early"),
        (lines("C1", 1).replace(",0.9,", ",-4,"), "out_of_range"),
    ],
)
def test_fault_has_its_reason(put, text, reason):
    (read,) = read_balanced(put("AAA/T1/hx/a.csv", text))
    assert reason in read.quarantine["reason"].to_list()


@pytest.fixture
def numbered_from_0(put) -> FileIntake:
    """What came of a file with cycle C1, whose packs are numbered 0 and 1, and C2, whose pack is 1."""
    first = LINE.format(flight="C1", second=1, hot=400.0)
    text = HEAD + first.replace("Z,1,", "Z,0,") + first + LINE.format(flight="C2", second=1, hot=400.0)
    return read_balanced(put("AAA/T1/hx/a.csv", text))[0]


def test_packs_from_0_are_refused(numbered_from_0):
    refused = numbered_from_0.quarantine
    assert refused["reason"].to_list() == ["bad_pack"] * 2
    assert refused["detail"].str.contains("count from 0").all()


def test_packs_from_0_cost_no_other_cycle(numbered_from_0):
    assert numbered_from_0.rows["flight_id"].unique().to_list() == ["C2"]


def test_unforeseen_failure_costs_one_file(put, monkeypatch):
    files = [put(f"AAA/T1/hx/{n}.csv", lines(f"C{n}", 4)) for n in (1, 2, 3)]
    real = intake.open_files

    def sick(files, *rest):
        if files[0].path.endswith("2.csv"):
            raise pl.exceptions.PanicException("so")
        return real(files, *rest)

    monkeypatch.setattr(intake, "open_files", sick)
    read = read_balanced(*files)
    assert [d.n_loaded for d in read] == [4, 0, 4]
    assert read[1].quarantine["reason"].to_list() == ["cannot_process"]


def point(name: str, content: object) -> SimpleNamespace:
    def load() -> object:
        if isinstance(content, Exception):
            raise content
        return content

    return SimpleNamespace(name=name, value=f"{name}:X", dist=SimpleNamespace(name="pkg"), load=load)


@pytest.fixture
def bring(monkeypatch):
    """Have packages bring something else for this test."""

    def instead(*points: SimpleNamespace) -> None:
        monkeypatch.setattr(loading, "entry_points", lambda group: points)
        readers.cache_clear()

    yield instead
    readers.cache_clear()


def reader(*folders: str) -> ModuleType:
    module = ModuleType("made")
    names = [n for n in dir(Reader) if not n.startswith("_")] + list(Reader.__annotations__)
    module.__dict__.update(dict.fromkeys(names, lambda *_: None), FOLDERS=folders)
    return module


@pytest.mark.parametrize(("content", "message"), [
    (RuntimeError("no licence"), "can't be loaded: RuntimeError: no licence"),
    (ModuleType("empty"), "is no Reader"),
    (reader("tapes", "drums"), "there is a reader of drums/ already"),
])  # fmt: skip
def test_broken_reader_is_named(bring, content, message):
    bring(point("first", reader("drums")), point("second", content))
    with pytest.raises(ReaderError, match=rf"the reader second \(second:X, of the package pkg\):? {message}"):
        readers()


def test_each_folder_has_its_reader(bring):
    one = reader("drums")
    other = reader("tapes", "wires")
    bring(point("a", one), point("b", other))
    assert readers() == {"drums": one, "tapes": other, "wires": other}


def test_folder_without_reader_is_set_aside(bring, tmp_path):
    files = ("recorder/T-1_20240101_01.dat", "reports/a.dat", "cpl/a.parquet")
    for path in ("types/T.toml", *(f"AAA/T-1/{file}" for file in files)):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).touch()
    bring()
    listed = list_landing(tmp_path)
    assert [f.path for f in listed.files] == ["AAA/T-1/cpl/a.parquet"]
    details = dict(listed.quarantine.select("file", "detail").rows())
    assert sorted(details) == ["AAA/T-1/recorder", "AAA/T-1/reports", "types"]
    assert all("hdt_recorder of the package hybrid-digital-twin-extensions reads it" in why for why in details.values())


def test_recording_without_reader_gives_nothing(bring, tmp_path):
    """An earlier night had one; the quarantine says why."""
    bring()
    path = "AAA/T-1/recorder/T-1_20240101_01.dat"
    (tmp_path / path).parent.mkdir(parents=True)
    (tmp_path / path).write_bytes(b"x")
    file = LandingFile(str(tmp_path), path, "AAA", "T-1", "recorder", 1, 0)
    intake = read_snapshots([file])
    assert (intake.rows.height, intake.delivered["n_delivered"].sum()) == (0, 0)
    assert "recorder/: hdt_recorder of the package" in intake.quarantine["detail"].item()
    assert read_components([file], NOW) == []
