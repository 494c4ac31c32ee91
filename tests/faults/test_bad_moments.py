"""What one bad moment of a night took away comes with the next: tables end as if it had not been."""

import os
import shutil
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from command import hdt
from zones import STAMP, drop_fleet, simulated

from benchmarks.fault_points import fingerprint
from pipelines.assets import raw
from pipelines.lineage import STAGES
from pipelines.orchestration import nightly


@pytest.fixture(scope="module", autouse=True)
def stages_that_read() -> Iterator[None]:
    """Nights go as far as the legs: what follows reads no file."""
    with pytest.MonkeyPatch.context() as within:
        within.setattr(nightly, "STAGES", [stage for stage in STAGES if stage.group in ("raw", "record", "legs")])
        yield


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A landing zone of four flights, and its home after an undisturbed night. Read only."""
    root = tmp_path_factory.mktemp("clean")
    zone = simulated(5, 4, operator="QQX", tail="Z9", cpl=1)
    drop_fleet(root / "landing", [zone])
    zone.only(zone.flights[:2]).drop_history(root / "landing")
    zone.only(zone.flights[2:]).drop_csv(root / "landing")
    zone.drop_logs(root / "landing")
    zone.drop_papers(root / "landing")
    assert hdt("nightly", "--landing", root / "landing", "--home", root / "home").returncode == 0
    return root / "landing", root / "home"


@pytest.fixture
def folders(clean: tuple[Path, Path], tmp_path: Path) -> tuple[Path, Path]:
    """A copy of the landing zone and a new home."""
    shutil.copytree(clean[0], tmp_path / "landing", copy_function=shutil.copy2)
    return tmp_path / "landing", tmp_path / "home"


def night(landing: Path, home: Path):
    return hdt("nightly", "--landing", landing, "--home", home)


def disturbed_night(landing: Path, home: Path, happen: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch):
    """A night at which something happens to the landing zone after its scan; later the zone is as it was."""
    copy = shutil.copytree(landing, landing.with_name("copy"), copy_function=shutil.copy2)

    def scan(*arguments):
        zone = real(*arguments)
        happen(landing)
        return zone

    real = nightly.scan
    with monkeypatch.context() as within:
        within.setattr(nightly, "scan", scan)
        result = night(landing, home)
    shutil.rmtree(landing)
    copy.rename(landing)
    return result


def unmount(landing: Path) -> None:
    for entry in landing.iterdir():
        shutil.rmtree(entry) if entry.is_dir() else entry.unlink()


def rename_aircraft(landing: Path) -> None:
    (landing / "QQX/Z9").rename(landing / "QQX/Z9.part")


def cut_all_files(landing: Path) -> None:
    for file in landing.glob("*/*/**/*.*"):
        os.truncate(file, file.stat().st_size // 2)


def exchange_flights(landing: Path) -> None:
    first, second = sorted(landing.glob("*/*/acms/*.csv"))
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)


def remove_log(landing: Path) -> None:
    shutil.rmtree(landing / "QQX/Z9/cpl")


MOMENTS = [unmount, rename_aircraft, cut_all_files, exchange_flights, remove_log]


@pytest.mark.parametrize("happen", MOMENTS)
def test_next_night_brings_lost_files(clean, folders, happen, monkeypatch):
    disturbed_night(*folders, happen, monkeypatch)

    assert night(*folders).returncode == 0
    assert fingerprint(folders[1]) == fingerprint(clean[1])


def test_night_names_vanished_zone(folders, monkeypatch):
    result = disturbed_night(*folders, unmount, monkeypatch)

    assert result.returncode == 1
    assert [line.split(": ")[1] for line in result.stderr.splitlines() if "vanished" in line] == ["landing zone"]


def test_lost_files_make_no_run(folders, monkeypatch):
    landing, home = folders
    disturbed_night(landing, home, rename_aircraft, monkeypatch)
    rename_aircraft(landing)
    night(landing, home)

    result = night(landing, home)

    assert "Nothing new" in result.stdout


class TenYearsBehind(datetime):
    @classmethod
    def now(cls, tz=None):
        return datetime.now(tz) - timedelta(days=3653)


def test_logs_come_with_right_clock(clean, folders, monkeypatch):
    with monkeypatch.context() as within:
        within.setattr(raw, "datetime", TenYearsBehind)
        night(*folders)

    assert night(*folders).returncode == 0
    assert fingerprint(folders[1]) == fingerprint(clean[1])


def test_future_message_makes_no_run(folders):
    landing, home = folders
    with open(landing / "QQX/Z9/messages.csv", "a") as log:
        log.write(f"{datetime.now(UTC) + timedelta(days=900):{STAMP}},,1,21-52-HXTEMP,hot\n")
    night(landing, home)

    assert "Nothing new" in night(landing, home).stdout
