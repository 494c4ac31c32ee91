"""A run from Dagster's page beside a night: whatever it stores when, the next night ends as if it had not been."""

import shutil
from collections.abc import Callable
from pathlib import Path

import dagster as dg
import pytest
from zones import drop_fleet, simulated

from benchmarks.fault_points import fingerprint
from pipelines.definitions import build_defs
from pipelines.lineage import STAGE
from pipelines.orchestration.runs import open_instance
from pipelines.resources import PartitionScope

ZONE = simulated(5, 5, operator="QQX", tail="Z9")
AIRCRAFT = "QQX:Z9"


@pytest.fixture(scope="module")
def first(children, tmp_path_factory) -> Path:
    """A landing zone of four flights and a home after a night over it. Read only."""
    root = tmp_path_factory.mktemp("first")
    drop_fleet(root / "landing", [ZONE])
    ZONE.only(ZONE.flights[:4]).drop_csv(root / "landing")
    ZONE.drop_papers(root / "landing")
    assert children.night(root / "landing", children.home(root / "home")) == (0, "")
    return root


@pytest.fixture(scope="module")
def end(first, children, tmp_path_factory) -> dict[str, str]:
    """The tables after a second night, with a fifth flight."""
    own = Path(shutil.copytree(first, tmp_path_factory.mktemp("end") / "own"))
    ZONE.only(ZONE.flights[4:]).drop_csv(own / "landing")
    assert children.night(own / "landing", own / "home") == (0, "")
    return fingerprint(own / "home")


@pytest.fixture
def own(first, tmp_path) -> Path:
    return Path(shutil.copytree(first, tmp_path / "own", copy_function=shutil.copy2))


def run_from_page(root: Path, stage: str) -> bool:
    """Make a stage of the aircraft, of its first flight if it goes by flight; whether the run succeeded."""
    flight = f"|{ZONE.flights[0][-11:]}" if STAGE[stage].grain == "flight" else ""
    defs = build_defs(landing=root / "landing", home=root / "home")
    keys = {dg.AssetKey(table) for table in STAGE[stage].tables}
    job = defs.resolve_implicit_global_asset_job_def().get_subset(asset_selection=keys)
    with open_instance(root / "home") as instance:
        return job.execute_in_process(
            instance=instance, partition_key=f"{AIRCRAFT}{flight}", raise_on_error=False
        ).success


def once_read(monkeypatch: pytest.MonkeyPatch, table: str, work: Callable[[], None]) -> None:
    """Have `work` done when a run in this process has read `table`."""
    read = PartitionScope.read_table

    def read_slowly(scope, store, name):
        frame = read(scope, store, name)
        if name == table:
            work()
        return frame

    monkeypatch.setattr(PartitionScope, "read_table", read_slowly)


@pytest.mark.parametrize(
    ("stage", "read"),
    [("twin_health", "raw_maintenance"), ("features", "raw_maintenance"), ("features_alerts", "features")],
)
def test_a_page_run_over_a_night_loses_nothing(own, end, children, monkeypatch, stage, read):
    def fly() -> None:
        ZONE.only(ZONE.flights[4:]).drop_csv(own / "landing")
        assert children.night(own / "landing", own / "home") == (0, "")

    once_read(monkeypatch, read, fly)
    run_from_page(own, stage)
    assert children.night(own / "landing", own / "home") == (0, "")
    assert fingerprint(own / "home") == end


def test_a_page_run_beside_none_succeeds(own):
    before = fingerprint(own / "home")
    assert run_from_page(own, "twin_health")
    assert fingerprint(own / "home") == before
