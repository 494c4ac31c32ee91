"""A run from Dagster's page beside a night or another run: tables end as if each had come after the other."""

import multiprocessing
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from multiprocessing.synchronize import Barrier
from pathlib import Path

import dagster as dg
import pytest
from databases import SERVER, copy_ledger_to, new_database
from zones import drop_fleet, simulated

from benchmarks.fault_points import fingerprint
from hdt_core.tables import TABLES
from pipelines.definitions import build_defs
from pipelines.lineage import STAGE
from pipelines.orchestration.runs import open_instance
from pipelines.resources import PartitionScope
from pipelines.storage import database
from pipelines.storage.ledger import Ledger
from pipelines.storage.store import Store

ZONE = simulated(5, 5, operator="QQX", tail="Z9")
AIRCRAFT = "QQX:Z9"


@pytest.fixture(scope="module")
def first(children, tmp_path_factory) -> Path:
    """A landing zone of four flights and a home after a night over it. Read only."""
    root = tmp_path_factory.mktemp("first")
    drop_fleet(root / "landing", [ZONE])
    ZONE.only(ZONE.flights[:4]).drop_csv(root / "landing")
    ZONE.drop_papers(root / "landing")
    children.complete_night(root / "landing", children.home(root / "home"))
    return root


@pytest.fixture(scope="module")
def end(first, children, tmp_path_factory) -> dict[str, str]:
    """The tables after a second night, with a fifth flight."""
    own = Path(shutil.copytree(first, tmp_path_factory.mktemp("end") / "own"))
    ZONE.only(ZONE.flights[4:]).drop_csv(own / "landing")
    children.complete_night(own / "landing", own / "home")
    return fingerprint(own / "home")


@pytest.fixture
def own(first, tmp_path) -> Path:
    return Path(shutil.copytree(first, tmp_path / "own", copy_function=shutil.copy2))


def run_from_page(root: Path, stage: str, nth: int = 0) -> bool:
    """Make a stage of the aircraft, of its `nth` flight if it goes by flight; whether the run succeeded."""
    flight = f"|{ZONE.flights[nth][-11:]}" if STAGE[stage].grain == "flight" else ""
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
def test_page_run_over_night_loses_nothing(own, end, children, monkeypatch, stage, read):
    def fly() -> None:
        ZONE.only(ZONE.flights[4:]).drop_csv(own / "landing")
        children.complete_night(own / "landing", own / "home")

    once_read(monkeypatch, read, fly)
    run_from_page(own, stage)
    children.complete_night(own / "landing", own / "home")
    assert fingerprint(own / "home") == end


def test_lone_page_run_succeeds(own):
    before = fingerprint(own / "home")
    assert run_from_page(own, "twin_health")
    assert fingerprint(own / "home") == before


@pytest.fixture(params=["sqlite", "postgresql"])
def with_ledger(request, own, monkeypatch) -> Iterator[Path]:
    """A home after a night, whose ledger is a file or in a database."""
    if request.param == "postgresql" and not SERVER:
        pytest.skip("HDT_TEST_POSTGRES names no PostgreSQL server")
    with new_database() if request.param == "postgresql" else nullcontext("") as url:
        if url:
            copy_ledger_to(own / "home", url)
        monkeypatch.setenv(database.URL, url)
        yield own


def forget(home: Path, stage: str) -> None:
    """Take away what a stage has stored of the aircraft, of its first two flights if it goes by flight."""
    own = (ZONE.operator, ZONE.tail)
    flights = ZONE.flights[:2]
    tables = list(STAGE[stage].tables)
    for table in tables:
        if STAGE[stage].grain == "flight":
            Store(home).merge(table, {own: flights}, TABLES[table].schema.create_empty())
        else:
            Store(home).replace(table, [own], TABLES[table].schema.create_empty())
    Ledger(home).delete_cells(tables, own, flights if STAGE[stage].grain == "flight" else None)


def meet_before_storing(both: Barrier) -> None:
    """Have this process's run come to its turn to store when the other does."""
    turn = Ledger.turn

    def turn_with_other(ledger, *, shared):
        Ledger.turn = turn
        both.wait(120)
        return turn(ledger, shared=shared)

    Ledger.turn = turn_with_other


def stored(home: Path, stage: str) -> tuple[dict[str, str], list[list[tuple]]]:
    """The tables, and the cells of a stage with their versions."""
    return fingerprint(home), [Ledger(home).cells(table).sort("flight_id").rows() for table in STAGE[stage].tables]


@pytest.mark.parametrize(("stage", "nths"), [("twin_health", (0, 0)), ("legs", (0, 0)), ("legs", (0, 1))])
def test_parallel_page_runs_end_as_serial(with_ledger, stage, nths):
    home = with_ledger / "home"
    spawn = multiprocessing.get_context("spawn")
    forget(home, stage)
    assert all(run_from_page(with_ledger, stage, nth) for nth in nths)
    expected = stored(home, stage)
    forget(home, stage)
    with ProcessPoolExecutor(2, spawn, meet_before_storing, (spawn.Barrier(2),)) as pool:
        runs = [pool.submit(run_from_page, with_ledger, stage, nth) for nth in nths]
    assert [run.result() for run in runs] == [True, True]
    assert stored(home, stage) == expected
