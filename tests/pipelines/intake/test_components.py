"""Files of declared components: every line accounted for, one delivery of a flight, aircraft kept apart."""

from dataclasses import replace
from datetime import UTC, datetime

import polars as pl
import pytest

from hdt_core.components import Channel, Record
from hdt_core.components.pack import HX
from hdt_core.physics.heat_exchanger import HEAT_EXCHANGER
from pipelines.intake import components as intake
from pipelines.intake.landing_file import FileIntake, LandingFile

NOW = datetime(2026, 1, 1, tzinfo=UTC)
CHANNELS = tuple(
    Channel(f"{name}_si", name, "", name, low=0.0, high=1000.0)
    for name in ("hot_flow_kg_s", "ram_flow_kg_s", "hot_in_k", "cold_in_k")
)
LINE = "{flight},2025-06-01T00:00:{second:02d}Z,1,0.9,1.6,{hot},250\n"
HEAD = "flight_id,report_time,pack,hot_flow_kg_s_si,ram_flow_kg_s_si,hot_in_k_si,cold_in_k_si\n"


@pytest.fixture(autouse=True)
def declared_components(monkeypatch) -> None:
    """An exchanger with files of its own."""
    own = replace(HX, model=HEAT_EXCHANGER, record=Record(CHANNELS))
    monkeypatch.setattr(intake, "recorded_components", lambda: {"hx": own})


@pytest.fixture
def deliver(tmp_path):
    def write(path: str, text: str) -> LandingFile:
        place = tmp_path / path
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text)
        operator, tail, *_ = path.split("/")
        return LandingFile(str(tmp_path), path, operator, tail, "component", len(text), 0)

    return write


def lines(flight: str, n: int, hot: float = 400.0) -> str:
    return HEAD + "".join(LINE.format(flight=flight, second=k, hot=hot) for k in range(n))


def delivered(files, now) -> list[FileIntake]:
    return [d for _, d in intake.read_components(files, now)]


def balanced(read: list[FileIntake]) -> bool:
    return all(d.n_delivered == d.n_loaded + int(d.quarantine["n_rows"].sum()) + d.n_duplicate for d in read)


def test_two_aircraft_may_name_their_flights_alike(deliver):
    files = [deliver(f"AAA/{tail}/hx/a.csv", lines("CYCLE-0001", 5, hot)) for tail, hot in (("T1", 400), ("T2", 410))]
    read = delivered(files, NOW)
    assert [d.n_loaded for d in read] == [5, 5]
    assert [d.rows.filter(signal="hot_in_k")["value"].unique().to_list() for d in read] == [[400.0], [410.0]]
    assert balanced(read)


def test_of_two_deliveries_of_a_flight_the_longer_is_stored_whole(deliver):
    short, long = deliver("AAA/T1/hx/b.csv", lines("C1", 3, 401)), deliver("AAA/T1/hx/a.csv", lines("C1", 6))
    read = delivered([long, short], NOW)
    assert [d.n_loaded for d in read] == [6, 0]
    assert read[1].quarantine["reason"].to_list() == ["conflicting_delivery"] * 3
    assert balanced(read)


def test_the_same_again_is_a_duplicate(deliver):
    files = [deliver(f"AAA/T1/hx/{n}.csv", lines("C1", 4)) for n in "ab"]
    read = delivered(files, NOW)
    assert sorted((d.n_loaded, d.n_duplicate) for d in read) == [(0, 4), (4, 0)]
    assert balanced(read)


def test_a_parquet_file_is_read_as_the_same_rows(deliver, tmp_path):
    text = deliver("AAA/T1/hx/a.csv", lines("C1", 5))
    frame = pl.read_csv(tmp_path / text.path).with_columns(pl.col("report_time").str.to_datetime(time_zone="UTC"))
    frame.write_parquet(tmp_path / "AAA/T1/hx/b.parquet")
    other = replace(text, path="AAA/T1/hx/b.parquet")
    first, second = (delivered([f], NOW)[0] for f in (text, other))
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
def test_what_is_wrong_is_told(deliver, text, reason):
    (read,) = delivered([deliver("AAA/T1/hx/a.csv", text)], NOW)
    assert reason in read.quarantine["reason"].to_list()
    assert balanced([read])


def test_a_file_that_fails_unforeseen_costs_itself_alone(deliver, monkeypatch):
    files = [deliver(f"AAA/T1/hx/{n}.csv", lines(f"C{n}", 4)) for n in (1, 2, 3)]
    real = intake.open_files

    def sick(files, *rest):
        if files[0].path.endswith("2.csv"):
            raise pl.exceptions.PanicException("so")
        return real(files, *rest)

    monkeypatch.setattr(intake, "open_files", sick)
    read = delivered(files, NOW)
    assert [d.n_loaded for d in read] == [4, 0, 4]
    assert read[1].quarantine["reason"].to_list() == ["cannot_process"]
