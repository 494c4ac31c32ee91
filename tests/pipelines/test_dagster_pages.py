"""What Dagster's pages tell of a night and of cells asked for there; its commands work in a fresh clone."""

import json
import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from graphlib import TopologicalSorter
from pathlib import Path

import dagster as dg
import pytest
from dagster._core.execution.backfill import BulkActionStatus, PartitionBackfill
from dagster._core.workspace.context import WorkspaceProcessContext
from dagster._core.workspace.load_target import ModuleTarget
from dagster._daemon.backfill import execute_backfill_iteration

from dagster_batched.runs import execute
from pipelines.assets import VIEWS
from pipelines.definitions import build_defs
from pipelines.orchestration.runs import LOCATION, open_instance, publish_night
from pipelines.resources import NIGHT
from pipelines.storage.catalog_checks import find_catalog_fault
from pipelines.storage.store import Store


def records_of(instance: dg.DagsterInstance, table: str) -> list[dg.EventLogRecord]:
    """The events of an asset's page, newest first."""
    return list(instance.fetch_materializations(dg.AssetKey(table), limit=5_000).records)


def numbers(record: dg.EventLogRecord) -> dict[str, object]:
    return {label: value.value for label, value in record.asset_materialization.metadata.items()}


@pytest.mark.parametrize(("table", "cell"), [("legs_samples", ("tail", "flight_id")), ("twin_health", ("tail",))])
def test_every_cell_has_its_event(sample_home, table, cell):
    frame = Store(sample_home).read_table(table)
    rows = {tuple(key): n for *key, n in frame.group_by(*cell).len().rows()}
    with open_instance(sample_home) as instance:
        events = records_of(instance, table)
    assert len({round(1000 * e.timestamp) for e in events}) == len(events) == len(rows)
    for event in events:
        tail, _, flight = event.partition_key.split(":")[1].partition("|")
        assert numbers(event) == {"rows": rows[(tail, f"{tail}_{flight}")[: len(cell)]]}


def test_last_flight_stands_first(sample_home):
    with open_instance(sample_home) as instance:
        events = records_of(instance, "raw_flights")
    for run_id in {e.run_id for e in events}:
        own = [e for e in events if e.run_id == run_id]
        flights = [e.partition_key.split("|")[1] for e in own]
        assert flights == sorted(flights, reverse=True)
        assert [e.timestamp for e in own] == sorted((e.timestamp for e in own), reverse=True)


def test_run_bears_its_nights_name(sample_home):
    with open_instance(sample_home) as instance:
        runs = [r for r in instance.get_runs(dg.RunsFilter(tags=NIGHT)) if "hdt/step" in r.tags]
        created = {r.dagster_run.run_id: r.create_timestamp for r in instance.get_run_records()}
    assert {r.tags["hdt/step"][11:] for r in runs} >= {"flights", "digital system model", "prognosis"}
    for run in runs:  # noon to noon: runs after midnight have the night's name
        began = created[run.run_id] - timedelta(hours=12)
        assert run.tags["hdt/step"].startswith(f"{began:%Y-%m-%d} ")


def test_groups_are_a_chain(sample_landing, tmp_path):
    """No arrow leads back: in the order of the stages, and so in no circle."""
    specs = {s.key: s for s in build_defs(landing=sample_landing, home=tmp_path).resolve_all_asset_specs()}
    chain = sorted({str(s.group_name) for s in specs.values()})
    assert [group[0] for group in chain] == list("123456789"), "the page lists groups by name"
    assert max(map(len, chain)) <= 16, "the graph shortens longer labels"
    made_from: dict[str, set[str]] = {group: set() for group in chain}
    for spec in specs.values():
        made_from[spec.group_name] |= {specs[d.asset_key].group_name for d in spec.deps} - {spec.group_name}
    assert all(before < group for group, all_ in made_from.items() for before in all_)
    assert set(TopologicalSorter(made_from).static_order()) == set(chain)


@pytest.mark.filterwarnings("ignore:Function `AssetSelection.sources`:DeprecationWarning")  # Dagster's own call
def test_backfill_of_unflown_flight_succeeds(own_home, monkeypatch):
    landing, home = own_home
    for name, folder in (("HDT_LANDING", landing), ("HDT_HOME", home)):
        monkeypatch.setenv(name, str(folder))
    defs = build_defs(landing=landing, home=home)
    graph = defs.resolve_asset_graph()
    keys = [dg.AssetKey(t) for t in ("twin_flights", "residuals")]
    with open_instance(home) as instance:
        cells = [instance.get_materialized_partitions(key) for key in keys]
        flown = sorted(cells[1])[:2]
        aircraft = min(cells[1]).split("|")[0]
        never = next(c for f in instance.get_dynamic_partitions("flight") if (c := f"{aircraft}|{f}") not in cells[0])
        before = Store(home).snapshot()
        backfill = PartitionBackfill.from_asset_partitions(
            "three", graph, [*flown, never], keys, time.time(), {}, instance, False, None, None, None
        )
        instance.add_backfill(backfill)
        where = ModuleTarget(LOCATION, attribute=None, working_directory=None, location_name=None)
        with WorkspaceProcessContext(instance, where) as workspace:
            for _ in range(20):
                assert not any(execute_backfill_iteration(workspace, logging.getLogger("backfill")))
                for run in instance.get_runs(dg.RunsFilter(statuses=[dg.DagsterRunStatus.QUEUED])):
                    job = defs.resolve_implicit_global_asset_job_def().get_subset(asset_selection=run.asset_selection)
                    assert execute(job, run.with_status(dg.DagsterRunStatus.NOT_STARTED), instance).success
                if (ended := instance.get_backfill("three")).status != BulkActionStatus.REQUESTED:
                    break
        assert ended.status == BulkActionStatus.COMPLETED_SUCCESS, ended.error
        for key in keys:
            newest = {e.partition_key: numbers(e) for e in records_of(instance, key.path[-1])[:3]}
            assert newest[never] == {"rows": 0, "expected": 0}
            assert all(newest[cell]["rows"] for cell in flown)
            assert never in instance.get_materialized_partitions(key)
    assert [files for _, files in Store(home).snapshot().values()] == [files for _, files in before.values()]


def test_page_publishes_like_a_night(own_home):
    landing, home = own_home
    defs = build_defs(landing=landing, home=home)
    with open_instance(home) as instance:
        publish_night(home, instance)
        nights = {key: instance.get_latest_materialization_event(key) for key in (view.key for view in VIEWS)}
        assert all(event.run_id == "" for event in nights.values())
        (home / "catalog.duckdb").unlink()
        keys = [*nights, dg.AssetKey("report")]
        job = defs.resolve_implicit_global_asset_job_def().get_subset(asset_selection=set(keys))
        assert job.execute_in_process(instance=instance).success
        assert all(instance.get_latest_materialization_event(key).run_id for key in keys)
    assert find_catalog_fault(home) is None
    assert (home / "report.html").stat().st_size > 100_000


@pytest.mark.filterwarnings("ignore:Parameter `include_sources`")  # Dagster's own call
def test_night_leaves_dagster_nothing(sample_landing, own_home):
    """The parent's own cell and no other; and where a table is newer than the views over it all are published again."""
    _, home = own_home
    defs = build_defs(landing=sample_landing, home=home)
    report = dg.AssetKey("report")
    residuals = dg.AssetKey("residuals")
    with open_instance(home) as instance:
        night = dg.evaluate_automation_conditions(defs, instance)
        assert night.total_requested == 0
        cell = min(instance.get_materialized_partitions(residuals))
        instance.report_runless_asset_event(dg.AssetMaterialization("twin_flights", partition=cell))
        newer = dg.evaluate_automation_conditions(defs, instance, cursor=night.cursor)
        assert newer.get_requested_partitions(residuals) == {cell}
        assert newer.get_num_requested(report) == 0
        event = dg.AssetMaterialization("features_alerts", partition=cell.split("|")[0])
        instance.report_runless_asset_event(event)
        published = dg.evaluate_automation_conditions(defs, instance, cursor=newer.cursor)
        assert {published.get_num_requested(key) for key in (report, *(view.key for view in VIEWS))} == {1}


ROOT = Path(__file__).parents[2]
DAGSTER = str(Path(sys.executable).with_name("dagster"))
QUESTION = "{ assetNodes { assetKey { path } } }"


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """What git has of the project, committed."""
    named = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=False).stdout.decode()
    code = (".gitignore", "dagster.yaml", "pyproject.toml", "hdt_core/", "pipelines/", "dagster_batched/", "sql/")
    for name in filter(lambda n: n.startswith(code) and (ROOT / n).is_file(), named.split("\0")):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, tmp_path / name)
    for words in (["init", "-q"], ["add", "-A"]):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    return tmp_path


@contextmanager
def start_dagster(clone: Path, *words: str, home: bool) -> Iterator[subprocess.Popen[str]]:
    """Dagster's own command in the clone, ended as by Ctrl+C; `home` sets DAGSTER_HOME to the clone."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("DAGSTER_", "HDT_"))}
    environment |= {"PYTHONPATH": str(clone), "PATH": f"{Path(DAGSTER).parent}{os.pathsep}{os.environ['PATH']}"}
    environment |= {"DAGSTER_HOME": str(clone)} if home else {}
    with subprocess.Popen(
        [DAGSTER, *words],
        cwd=clone,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,  # Ctrl+C reaches all of a terminal's processes
    ) as process:
        try:
            yield process
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGINT)
                try:
                    process.communicate(timeout=60)
                except subprocess.TimeoutExpired:
                    os.killpg(process.pid, signal.SIGKILL)


def new_files(clone: Path) -> str:
    """What git would show as new."""
    command = ["git", "status", "--porcelain", "--untracked-files=all"]
    return subprocess.run(command, cwd=clone, capture_output=True, text=True, check=True).stdout.replace("A  ", "")


def test_definitions_validate_without_home(clone):
    before = new_files(clone)
    with start_dagster(clone, "definitions", "validate", home=False) as process:
        words = process.communicate(timeout=120)[0]
    assert process.returncode == 0, words[-2000:]
    assert "All code locations passed validation" in words
    assert new_files(clone) == before
    assert (clone / "hdt_home/dagster/history").is_dir()  # where `hdt --home hdt_home` keeps it


def test_dev_answers_with_home(clone):
    before = new_files(clone)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    address = f"http://127.0.0.1:{port}/graphql"
    question = json.dumps({"query": QUESTION}).encode()
    request = urllib.request.Request(address, question, {"Content-Type": "application/json"})

    nodes = None
    with start_dagster(clone, "dev", "--port", str(port), home=True) as process:
        while nodes is None:
            try:
                with urllib.request.urlopen(request, timeout=30) as answer:
                    nodes = json.loads(answer.read())["data"]["assetNodes"]
            except (urllib.error.URLError, ConnectionError):
                assert process.poll() is None, process.communicate()[0][-2000:]
                time.sleep(0.3)
        running = new_files(clone)
    assert ["prognoses"] in [n["assetKey"]["path"] for n in nodes]
    assert before == running == new_files(clone)
