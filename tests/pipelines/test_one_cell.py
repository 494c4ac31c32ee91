"""What is made from Dagster's page or command, cell, range or all, leaves the store as a night left it."""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dagster as dg
import polars as pl
import pytest

from dagster_batched.runs import range_tags
from hdt_core.tables import TABLES
from pipelines.definitions import build_defs
from pipelines.lineage import STAGE, STAGES
from pipelines.orchestration.runs import open_instance
from pipelines.storage.ledger import Ledger
from pipelines.storage.store import Store

ONE = "AQX:LX-AAB"
OTHER = "BZR:A9-BAC"


@dataclass(frozen=True)
class Page:
    """What Dagster's page starts runs of."""

    defs: dg.Definitions
    instance: dg.DagsterInstance
    home: Path
    night: dict[str, tuple[list[str], pl.DataFrame]]

    def materialize(self, stages: list[str], **options: Any) -> None:
        """Run some stages for a `partition_key` or a range's `tags`."""
        keys = {dg.AssetKey(table) for name in stages for table in STAGE[name].tables}
        job = self.defs.resolve_implicit_global_asset_job_def().get_subset(asset_selection=keys)
        assert job.execute_in_process(instance=self.instance, **options).success


def stored_cells(home) -> dict[str, tuple[list[str], pl.DataFrame]]:
    """Of each table its files, named by their content, and which cells the ledger says are made as what."""
    ledger = Ledger(home)
    files = Store(home).snapshot()
    return {t: (files[t][1], ledger.cells(t).sort(pl.all())) for t in TABLES}


def changed_tables(page) -> list[str]:
    """Tables that are not as the night left them."""
    now = stored_cells(page.home)
    return [t for t in TABLES if page.night[t][0] != now[t][0] or not page.night[t][1].equals(now[t][1])]


@pytest.fixture(scope="module")
def page(sample_landing, sample_home, tmp_path_factory) -> Iterator[Page]:
    """Of a home of its own, which every test leaves as it was."""
    home = shutil.copytree(sample_home, tmp_path_factory.mktemp("page") / "home")
    with open_instance(home) as instance:
        yield Page(build_defs(landing=sample_landing, home=home), instance, home, stored_cells(home))


def flown_cells(page: Page, aircraft: str) -> list[str]:
    """Cells of an aircraft in order of departure."""
    cells = page.instance.get_materialized_partitions(dg.AssetKey("residuals"))
    return sorted(cell for cell in cells if cell.startswith(f"{aircraft}|"))


# the calibration's, three seconds, is made beside a flight's below
@pytest.mark.parametrize("stage", [s for s in STAGES if s.name != "calibration"], ids=lambda stage: stage.name)
def test_remade_cell_changes_nothing(page, stage):
    cell = {"flight": flown_cells(page, ONE)[40], "aircraft": ONE, "fleet": None}[stage.grain]
    page.materialize([stage.name], partition_key=cell)
    assert changed_tables(page) == []


def test_remade_range_changes_nothing(page):
    first = flown_cells(page, ONE)[40]
    last = flown_cells(page, OTHER)[60]
    per_flight = [stage.name for stage in STAGES if stage.grain == "flight"]
    page.materialize(per_flight, tags=range_tags(first, last))
    page.materialize([stage.name for stage in STAGES if stage.grain == "aircraft"], tags=range_tags(ONE, OTHER))
    assert changed_tables(page) == []


def test_cell_beside_fleet_changes_nothing(page):
    """One run makes a flight of the one and all of the other."""
    page.materialize(["twin_flights", "calibration"], partition_key=flown_cells(page, ONE)[40])
    assert changed_tables(page) == []


def test_run_without_cells_is_refused(page):
    with pytest.raises(dg.DagsterInvariantViolationError):
        page.materialize(["twin_flights"])
    assert changed_tables(page) == []
