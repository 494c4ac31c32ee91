"""The entry point `hdt.readers`: what a package must bring, and what a landing zone is without one."""

from datetime import UTC, datetime
from types import ModuleType, SimpleNamespace

import pytest

from hdt_core import loading
from pipelines.intake.components import read_components
from pipelines.intake.landing import list_landing
from pipelines.intake.landing_file import LandingFile
from pipelines.intake.readers import Reader, ReaderError, readers
from pipelines.intake.snapshots import read_snapshots

NOW = datetime(2026, 1, 1, tzinfo=UTC)


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
def test_a_package_that_brings_none_is_named_in_one_line(bring, content, message):
    bring(point("first", reader("drums")), point("second", content))
    with pytest.raises(ReaderError, match=rf"the reader second \(second:X, of the package pkg\):? {message}"):
        readers()


def test_each_folder_has_its_reader(bring):
    one, other = reader("drums"), reader("tapes", "wires")
    bring(point("a", one), point("b", other))
    assert readers() == {"drums": one, "tapes": other, "wires": other}


def test_without_a_reader_folders_are_set_aside_by_name_and_nothing_else_is(bring, tmp_path):
    for path in (
        "types/T.toml",
        "AAA/T-1/recorder/T-1_20240101_01.dat",
        "AAA/T-1/reports/a.dat",
        "AAA/T-1/cpl/a.parquet",
    ):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).touch()
    bring()
    listed = list_landing(tmp_path)
    assert [f.path for f in listed.files] == ["AAA/T-1/cpl/a.parquet"]
    details = dict(listed.quarantine.select("file", "detail").rows())
    assert sorted(details) == ["AAA/T-1/recorder", "AAA/T-1/reports", "types"]
    assert all("hdt_recorder of the package hybrid-digital-twin-extensions reads it" in why for why in details.values())


def test_a_recording_of_earlier_nights_gives_nothing_and_says_why(bring, tmp_path):
    bring()
    path = "AAA/T-1/recorder/T-1_20240101_01.dat"
    file = LandingFile(str(tmp_path), path, "AAA", "T-1", "recorder", 1, 0)
    intake = read_snapshots([file], NOW)
    assert (intake.rows.height, intake.delivered["n_delivered"].sum()) == (0, 0)
    assert "recorder/: hdt_recorder of the package" in intake.quarantine["detail"].item()
    assert read_components([file], NOW) == []
