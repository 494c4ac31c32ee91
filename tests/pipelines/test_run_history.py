"""Old runs leave Dagster's history; the state of every cell, and what is under way, stay."""

import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import dagster as dg
import pytest
from dagster._core.storage.partition_status_cache import get_and_update_asset_status_cache_value
from databases import SERVER, new_database

from dagster_batched import history, report_partitions
from dagster_batched.history import compact_files, forget_runs
from dagster_batched.runs import open_instance, range_tags
from pipelines.orchestration import history as after_night
from pipelines.orchestration.history import forget_old_runs
from pipelines.orchestration.runs import open_instance as open_home

aircraft = dg.DynamicPartitionsDefinition(name="aircraft")
flights = dg.DynamicPartitionsDefinition(name="flight")
both = dg.MultiPartitionsDefinition({"aircraft": aircraft, "flight": flights})
POSTGRES = """\
event_log_storage:
  module: dagster_batched.postgres
  class: BatchedPostgresEventLogStorage
  config: {{postgres_url: "{url}"}}
run_storage:
  module: dagster_postgres.run_storage
  class: PostgresRunStorage
  config: {{postgres_url: "{url}"}}
telemetry: {{enabled: false}}
"""


class Whole(dg.IOManager):
    """Reports all cells of a run by one event."""

    def handle_output(self, context, obj) -> None:
        report_partitions(context, list(context.asset_partition_keys))

    def load_input(self, context) -> None:
        """Nothing is stored."""


@dg.asset(partitions_def=both)
def cells() -> int:
    """A cell an aircraft and flight."""
    return 1


@dg.asset(partitions_def=both)
def broken() -> None:
    """Cells that fail."""
    raise ValueError


@dg.asset
def plain() -> None:
    """An asset without partitions."""


@pytest.fixture(params=["sqlite", "postgresql"])
def instance(request, tmp_path) -> Iterator[dg.DagsterInstance]:
    """A new instance with two aircraft and four flights; in PostgreSQL where HDT_TEST_POSTGRES names a server."""
    if request.param == "postgresql" and not SERVER:
        pytest.skip("HDT_TEST_POSTGRES names no PostgreSQL server")
    with ExitStack() as stack:
        if request.param == "postgresql":
            (tmp_path / "dagster.yaml").write_text(POSTGRES.format(url=stack.enter_context(new_database())))
        opened = stack.enter_context(open_instance(tmp_path, "# ours", "made here"))
        opened.add_dynamic_partitions("aircraft", ["A", "B"])
        opened.add_dynamic_partitions("flight", ["1", "2", "3", "4"])
        yield opened


def make(instance: dg.DagsterInstance, asset, first: str | None = None, last: str | None = None) -> str:
    """The id of a run over a range of cells."""
    tags = range_tags(first, last or first) if first else {}
    resources = {"io_manager": Whole()}
    return dg.materialize([asset], instance=instance, tags=tags, resources=resources, raise_on_error=False).run_id


def now() -> datetime:
    return datetime.now(UTC) + timedelta(seconds=1)


def run_ids(instance: dg.DagsterInstance) -> set[str]:
    return {run.run_id for run in instance.get_runs()}


def materialized(instance: dg.DagsterInstance) -> set[str]:
    """The cells that the partitions page shows as materialized, as it finds them for the first time."""
    instance.wipe_asset_cached_status([cells.key])
    status = get_and_update_asset_status_cache_value(instance, cells.key, both, instance)
    shown = set(status.deserialize_materialized_partition_subsets(both).get_partition_keys())
    assert shown == instance.get_materialized_partitions(cells.key)
    return shown


def test_older_run_goes_with_its_events(instance):
    old = make(instance, cells, "A|1")
    last = make(instance, cells, "A|2")
    assert forget_runs(instance, now()) == 1
    assert run_ids(instance) == {last}
    with instance.event_log_storage.index_connection() as con:
        assert con.exec_driver_sql(f"select count(*) from event_logs where run_id = '{old}'").scalar() == 0


def test_newer_run_remains(instance):
    old, last = make(instance, cells, "A|1"), make(instance, cells, "A|2")
    assert forget_runs(instance, datetime.now(UTC) - timedelta(hours=1)) == 0
    assert run_ids(instance) == {old, last}


def test_run_in_progress_remains(instance):
    started = instance.create_run_for_job(dg.Definitions([plain]).resolve_implicit_global_asset_job_def()).run_id
    instance.run_storage.handle_run_event(
        started, dg.DagsterEvent(dg.DagsterEventType.RUN_START.value, "__ASSET_JOB"), datetime.now(UTC)
    )
    assert forget_runs(instance, now()) == 0
    assert run_ids(instance) == {started}


def test_cells_stay_materialized(instance):
    make(instance, cells, "A|1", "B|2")
    make(instance, cells, "A|3")
    before = instance.get_materialized_partitions(cells.key)
    forget_runs(instance, now())
    assert materialized(instance) == before == {"A|1", "A|2", "B|1", "B|2", "A|3"}


def test_cells_last_event_has_its_id_time_and_versions(instance):
    def events() -> dict[str, tuple[int, float, dict[str, str]]]:
        records = instance.fetch_materializations(cells.key, limit=10).records
        return {r.partition_key: (r.storage_id, r.timestamp, r.asset_materialization.tags) for r in records}

    make(instance, cells, "A|1", "B|2")
    make(instance, cells, "A|3")
    before = events()
    forget_runs(instance, now())
    assert events() == before


def test_remade_cell_has_one_event(instance):
    for _ in range(3):
        make(instance, cells, "A|1")
        make(instance, cells, "A|2")
        forget_runs(instance, now())
    events = instance.fetch_materializations(cells.key, limit=10).records
    assert sorted(e.partition_key for e in events) == ["A|1", "A|2"]


def test_failed_cells_run_remains(instance):
    failed = make(instance, broken, "A|1")
    instance.event_log_storage.mark_failed_partitions(failed, ["A|1"])
    make(instance, broken, "A|2")
    forget_runs(instance, now())
    assert failed in run_ids(instance)


def test_last_run_of_each_asset_remains(instance):
    make(instance, plain)
    last = {make(instance, plain), make(instance, cells, "A|1")}
    forget_runs(instance, now())
    assert run_ids(instance) == last


def test_run_beyond_the_bound_waits(instance):
    for flight in "123":
        make(instance, cells, f"A|{flight}")
    assert forget_runs(instance, now(), most_events=1) == 0
    assert len(run_ids(instance)) == 3
    assert [forget_runs(instance, now(), most_events=50) for _ in range(2)] == [2, 0]


def test_old_reports_of_no_run_go(instance):
    for _ in range(3):
        instance.report_runless_asset_event(dg.AssetMaterialization("view"))
    forget_runs(instance, now())
    assert len(instance.fetch_materializations(dg.AssetKey("view"), limit=10).records) == 1


class KilledError(Exception):
    """The process ends here."""


STEPS = ["_short_row", "_delete_checks", "_delete_reports", "_delete_shard", "_return_pages"]


@pytest.mark.parametrize("step", STEPS)
def test_kill_loses_nothing(tmp_path, monkeypatch, step):
    def kill(*_: object) -> None:
        raise KilledError

    with open_instance(tmp_path, "# ours", "made here") as instance:
        instance.add_dynamic_partitions("aircraft", ["A", "B"])
        instance.add_dynamic_partitions("flight", ["1", "2"])
        make(instance, cells, "A|1", "B|1")
        last = make(instance, cells, "A|2")
        before = instance.get_materialized_partitions(cells.key)
        with monkeypatch.context() as patch:
            patch.setattr(history, step, kill)
            with pytest.raises(KilledError):
                forget_runs(instance, now())
        assert materialized(instance) == before
        forget_runs(instance, now())
        assert materialized(instance) == before
        assert run_ids(instance) == {last}
    shards = {f.stem for f in (tmp_path / "history").glob("*-*.db")}
    assert shards == {last}


def test_files_shrink(tmp_path):
    with open_instance(tmp_path, "# ours", "made here") as instance:
        instance.add_dynamic_partitions("aircraft", ["A"])
        keys = [f"{n:04}" for n in range(2_000)]
        instance.add_dynamic_partitions("flight", keys)
        for _ in range(2):
            make(instance, cells, f"A|{keys[0]}", f"A|{keys[-1]}")
        before = size_bytes(tmp_path)
        forget_runs(instance, now())
        after_night_bytes = size_bytes(tmp_path)
        assert after_night_bytes < 0.75 * before
        compact_files(instance)
    assert size_bytes(tmp_path) < 0.9 * after_night_bytes


def size_bytes(base: Path) -> int:
    """Size of the index, its log written back."""
    with closing(sqlite3.connect(base / "history" / "index.db")) as con:
        con.execute("pragma wal_checkpoint(truncate)")
    return (base / "history" / "index.db").stat().st_size


def age(home: Path, days: int) -> None:
    """Let all runs of a home have ended so many days ago."""
    with closing(sqlite3.connect(home / "dagster" / "history" / "runs.db")) as con:
        con.execute("update runs set update_timestamp = datetime('now', ?)", (f"-{days} days",))
        con.commit()


@pytest.mark.parametrize(("text", "left"), [("", 2), ("dagster_history_days = 10", 1)], ids=["default", "ten days"])
def test_setting_is_honoured(tmp_path, text, left):
    (tmp_path / "retention.toml").write_text(text)
    with open_home(tmp_path) as instance:
        for _ in range(2):
            make(instance, plain)
        age(tmp_path, days=20)
        assert forget_old_runs(tmp_path, instance, cells=0) == ()
        assert len(run_ids(instance)) == left


def test_nothing_goes_after_a_jump_of_the_clock(tmp_path, monkeypatch):
    monkeypatch.setattr(after_night, "has_jumped", lambda *_: True)
    with open_home(tmp_path) as instance:
        for _ in range(2):
            make(instance, plain)
        age(tmp_path, days=200)
        forget_old_runs(tmp_path, instance, cells=0)
        assert len(run_ids(instance)) == 2


def test_locked_history_is_told(tmp_path, monkeypatch):
    def refuse(*_: object) -> None:
        raise OSError("the disk is full")

    monkeypatch.setattr(after_night, "forget_runs", refuse)
    with open_home(tmp_path) as instance:
        (line,) = forget_old_runs(tmp_path, instance, cells=0)
    assert line == "Dagster's history is not shortened: the disk is full"
