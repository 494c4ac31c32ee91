"""What `dagster dev` shows: every stage, with owners, kinds, descriptions, checks and the agreed partitions."""

import pickle
import tomllib
from pathlib import Path

import dagster as dg
import polars as pl
import pytest
from dagster._core.definitions.data_version import CachingStaleStatusResolver, StaleStatus
from dagster._core.execution.context.system import StepExecutionContext
from dagster._core.loader import LoadingContextForTest
from nights import run

from hdt_core.tables import TABLES
from pipelines import definitions, resources
from pipelines.assets.stage import CHECK, _check_and_store
from pipelines.definitions import build_defs
from pipelines.lineage import LINEAGE, STAGE
from pipelines.orchestration.runs import LOCATION, EngineError, open_instance
from pipelines.resources import NIGHT, Home
from pipelines.storage.ledger import Ledger
from pipelines.storage.view_headers import read_header, views

GROUPS = {
    "1_recorder_files", "2_record", "3_flight_legs", "4_system_model", "5_twin",
    "6_residuals", "7_health_alerts", "8_prognosis", "9_catalog_report",
}  # fmt: skip


@pytest.fixture(scope="module")
def defs(tmp_path_factory) -> dg.Definitions:
    base = tmp_path_factory.mktemp("defs")
    return build_defs(landing=base, home=base / "home")


@pytest.fixture(scope="module")
def specs(defs) -> dict[str, dg.AssetSpec]:
    """By table, by `catalog/VIEW`, and the report."""
    return {"/".join(s.key.path): s for s in defs.resolve_all_asset_specs()}


def test_every_table_has_an_asset(specs):
    assert set(specs) == {*TABLES, *(f"catalog/{view}" for view in views()), "report"}
    assert set(TABLES) == set(LINEAGE)
    assert {s.group_name for s in specs.values()} == GROUPS


def names_upstream(spec: dg.AssetSpec) -> set[str]:
    return {d.asset_key.path[-1] for d in spec.deps}


def test_report_depends_on_views(specs):
    assert {"unit_rows", "alert_states", "quarantine"} <= names_upstream(specs["report"]) < set(views())


@pytest.mark.parametrize(("table", "recipe"), LINEAGE.items(), ids=LINEAGE)
def test_asset_depends_on_its_parents(specs, table, recipe):
    upstream = names_upstream(specs[table])
    stems = {u.split("_")[0] for u in upstream}
    assert [p for p in recipe.parents if p not in upstream and p.split("_")[0] not in stems] == []


def test_assets_of_files_wait_for_nights(specs):
    alone = {key for key, spec in specs.items() if spec.automation_condition}
    # none of what is made from files; nor what follows a baseline, which seldom moves when its parents do
    files = {table for table, recipe in LINEAGE.items() if recipe.files or recipe.baseline or not recipe.parents}
    assert alone == set(specs) - files


@pytest.mark.parametrize("view", views())
def test_view_depends_on_its_sources(specs, view):
    spec = specs[f"catalog/{view}"]
    header = read_header(views()[view])
    read = {name.removeprefix("tables.") if "." in name else f"catalog/{name}" for name in header.sources}
    assert {"/".join(d.asset_key.path) for d in spec.deps} == read
    assert spec.description.startswith(header.question)


@pytest.mark.parametrize("table", TABLES)
def test_asset_describes_itself(specs, table):
    spec = specs[table]
    assert (len(spec.owners), len(spec.kinds)) == (1, 2)
    assert "deltalake" in spec.kinds
    assert len(spec.description or "") > 30
    assert spec.code_version == LINEAGE[table].code
    partitions = {"flight": dg.MultiPartitionsDefinition, "aircraft": dg.DynamicPartitionsDefinition}
    expected = partitions.get(TABLES[table].grain)
    assert expected is None if spec.partitions_def is None else isinstance(spec.partitions_def, expected)


def test_every_asset_has_blocking_check(defs):
    graph = defs.resolve_asset_graph()
    keys = {(k.asset_key.path[-1], k.name) for k in graph.asset_check_keys}
    assert {(t, CHECK) for t in TABLES} <= keys
    assert all(graph.get(k).blocking for k in graph.asset_check_keys)


def test_schedule_is_off_at_first(defs):
    schedules = {s.name: s.default_status for s in defs.get_repository_def().schedule_defs}
    assert schedules == {"every_night": dg.DefaultScheduleStatus.STOPPED}


def test_sensors_are_off_at_first(defs):
    sensors = {s.name: s.default_status for s in defs.get_repository_def().sensor_defs}
    names = ("landing_zone", "failed_night", "publish_what_is_newer", "make_what_follows")
    assert sensors == dict.fromkeys(names, dg.DefaultSensorStatus.STOPPED)


def test_failed_run_is_sent_to_receivers(tmp_path):
    (tmp_path / "notify.toml").write_text('[[receiver]]\nname = "all"\nkind = "file"\nfolder = "out"\n')
    home = Home(landing=str(tmp_path / "none"), home=str(tmp_path))
    with dg.DagsterInstance.ephemeral() as instance:
        job = build_defs(landing=home.landing, home=tmp_path).resolve_job_def("nightly")
        run = job.execute_in_process(instance=instance, raise_on_error=False)
        (event,) = [e for e in run.all_events if e.is_run_failure]
        context = dg.build_run_status_sensor_context("failed_night", event, instance, run.dagster_run)

        definitions.failed_night(context.for_run_failure(), home=home)

    (page,) = (tmp_path / "out").glob("*.txt")
    assert "no landing zone at" in page.read_text()


ACCOUNT = pl.DataFrame(
    {"operator": "AQX", "tail": "LX-AAA", "file": "a.csv", "flight_id": "LX-AAA_20240525_04",
     "delivered": 42, "loaded": 40, "quarantined": 1, "duplicate": 1}
)  # fmt: skip


def test_balanced_account_is_stored():
    """delivered = loaded + quarantined + duplicate."""
    (check, output) = _check_and_store("raw_deliveries", ACCOUNT, {}, {}, list)
    assert check.passed
    assert output.value.equals(ACCOUNT)


def test_unbalanced_account_blocks():
    """The table is not stored and nothing after it runs."""
    events = _check_and_store("raw_deliveries", ACCOUNT.with_columns(loaded=pl.lit(39, pl.Int64)), {}, {}, list)
    assert not next(events).passed
    with pytest.raises(dg.Failure, match="not stored: balances"):
        next(events)


@pytest.fixture
def look(sample_landing, tmp_path):
    """Let the sensor look at the landing zone."""
    home = Home(landing=str(sample_landing), home=str(tmp_path / "home"))

    def requests():
        with dg.build_sensor_context(resources={"home": home}) as context:
            return list(definitions.landing_zone(context))

    return requests


def test_sensor_waits_for_quiet(look, monkeypatch):
    monkeypatch.setattr(definitions, "QUIET_S", 10**12)
    (fresh,) = look()
    assert "waiting" in fresh.skip_message


def test_sensor_fires_once_a_state(look, monkeypatch):
    monkeypatch.setattr(definitions, "QUIET_S", -1)
    first, second = (look()[0].run_key for _ in range(2))
    assert first == second


def test_job_works_like_the_command(own_home):
    landing, home = own_home
    ledger = Ledger(home)
    ledger.mark("features_alerts", ledger.cells("features_alerts").with_columns(version=pl.lit("")))
    scheduled = {"dagster/schedule_name": "every_night"}
    job = build_defs(landing=landing, home=home).resolve_job_def("nightly")
    with open_instance(home) as instance:
        by_command = {run.run_id: run.tags for run in instance.get_runs()}
        done = job.execute_in_process(instance=instance, tags=scheduled)
        assert done.success
        assert (home / "report.html").exists()
        tags = {run.run_id: run.tags for run in instance.get_runs() if run.run_id not in {*by_command, done.run_id}}
        assert tags
        for own in tags.values():
            assert own.items() >= {**scheduled, **NIGHT, "hdt/night_run": done.run_id}.items()
            assert "user" not in own
    assert {own["user"] for own in by_command.values()} == {"hdt nightly"}


def test_project_names_the_definitions():
    tool = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["tool"]
    assert tool["dagster"]["module_name"] == tool["dg"]["project"]["code_location_target_module"] == LOCATION


def test_cell_key_equals_dagsters():
    (ours,) = resources.cell_keys([("AAA:T1", "20260101_02")])
    stock = dg.MultiPartitionKey({"flight": "20260101_02", "aircraft": "AAA:T1"})
    for other in (stock, pickle.loads(pickle.dumps(ours))):
        assert (ours, type(ours), ours.dimension_keys) == (other, type(other), other.dimension_keys)


def test_night_as_remote_run_is_refused(sample_landing, tmp_path):
    """It would hold a worker that a run of its own may wait behind."""
    (tmp_path / "dagster").mkdir()
    (tmp_path / "dagster/dagster.yaml").write_text("run_launcher:\n  module: any\n")
    job = build_defs(landing=sample_landing, home=tmp_path).resolve_job_def("nightly")
    with pytest.raises(EngineError, match="use cron"), dg.DagsterInstance.ephemeral() as instance:
        job.execute_in_process(instance=instance)


def test_night_leaves_no_stale_cell(own_home, monkeypatch):
    landing, home = own_home
    monkeypatch.setattr(StepExecutionContext, "asset_partitions_subset_for_input", None)
    ledger = Ledger(home)
    for table in STAGE["features"].tables:
        ledger.mark(table, ledger.cells(table).with_columns(version=pl.lit("")))
    night = run(landing, home)
    assert night.cells
    assert not night.failed
    graph = build_defs(landing=landing, home=home).resolve_asset_graph()
    with open_instance(home) as instance:
        resolver = CachingStaleStatusResolver(instance, graph, LoadingContextForTest(instance))
        for key in (dg.AssetKey(t) for t in ("features", "features_alerts", "legs_verdicts", "prognoses")):
            cells = instance.get_materialized_partitions(key) if graph.get(key).is_partitioned else [None]
            assert {resolver.get_status(key, cell) for cell in cells} == {StaleStatus.FRESH}
