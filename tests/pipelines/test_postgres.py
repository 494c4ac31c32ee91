"""Run history in PostgreSQL, as in production: the same cells are reported as in the embedded default.

Runs where HDT_TEST_POSTGRES names a server, as `postgresql://user@host:5432/database`.
"""

from collections.abc import Iterator
from pathlib import Path

import dagster as dg
import pytest
from databases import SERVER, new_database
from nights import Silent, stages_of

from hdt_core.simulate.design import FleetSettings
from pipelines.intake.simulated import write_fleet
from pipelines.orchestration import nightly
from pipelines.orchestration.runs import open_instance

pytestmark = pytest.mark.skipif(not SERVER, reason="HDT_TEST_POSTGRES names no PostgreSQL server")

SETTINGS = Path(__file__).parents[2] / "deploy/dagster.yaml"


@pytest.fixture
def database() -> Iterator[str]:
    """A database of the test's own."""
    with new_database() as url:
        yield url


def cells(instance: dg.DagsterInstance) -> dict[str, set[str]]:
    """Which cells of each asset have been made, by the instance's own account."""
    tables = [t for stage in stages_of(0, 5) if stage.grain == "flight" for t in stage.tables]
    return {t: set(instance.get_materialized_partitions(dg.AssetKey(t))) for t in tables}


def test_a_night_is_recorded_as_in_the_embedded_default(database: str, tmp_path: Path, monkeypatch) -> None:
    list(write_fleet(tmp_path, 3, FleetSettings(operators=1, tails=2, flights=12)))
    monkeypatch.setattr(nightly, "STAGES", stages_of(0, 5))
    (tmp_path / "production/dagster").mkdir(parents=True)
    (tmp_path / "production/dagster/dagster.yaml").write_text(SETTINGS.read_text())
    monkeypatch.setenv("HDT_POSTGRES_URL", database)
    recorded = []
    for home in (tmp_path / "embedded", tmp_path / "production"):
        night = nightly.run_night(tmp_path / "landing", home, Silent())
        assert not night.failed, night.failed
        instance = open_instance(home)
        recorded.append((type(instance.event_log_storage).__name__, cells(instance)))
        instance.dispose()
    (embedded, first), (postgres, second) = recorded
    assert (embedded, postgres) == ("BatchedSqliteEventLogStorage", "BatchedPostgresEventLogStorage")
    assert first == second
    assert all(len(c) >= 20 for name, c in first.items() if name in {"raw_snapshots", "legs_samples", "twin_flights"})
