"""Runs on record: those that a killed night left, those sent to other machines, and the partitions that they name."""

from collections.abc import Callable
from datetime import UTC, datetime

import dagster as dg
import polars as pl
import pytest
from dagster._core.storage.tags import AUTO_RETRY_RUN_ID_TAG

from pipelines.orchestration import runs
from pipelines.orchestration.batches import BatchResult, PartitionBatch
from pipelines.orchestration.runs import EngineError, RemoteExecutor, Runner
from pipelines.resources import NIGHT

BY_PEOPLE = {"user": "an engineer"}
ONE = PartitionBatch((("AAA:T1", ""),))
TWO = PartitionBatch((("AAA:T1", ""), ("AAA:T2", "")))


@dg.job
def no_work():
    """A job without a step."""


class Elsewhere(Runner):
    """Its runs do nothing; a test ends them as another machine would."""

    def job(self, tables):
        return no_work

    def create(self, job, batch, label):
        return self.instance.create_run_for_job(job, tags=batch.tags() | NIGHT)


@pytest.fixture
def instance():
    """An instance that lasts as long as the test."""
    with dg.DagsterInstance.ephemeral() as instance:
        yield instance


@pytest.fixture
def runner(instance) -> Runner:
    return Runner(dg.Definitions(), instance, None, {})


def start(instance: dg.DagsterInstance, run: dg.DagsterRun) -> None:
    """Record that a run has started, as its process does."""
    report(instance, run, dg.DagsterEventType.PIPELINE_START)


def succeed(instance: dg.DagsterInstance, run: dg.DagsterRun) -> None:
    report(instance, run, dg.DagsterEventType.PIPELINE_SUCCESS)


def report(instance: dg.DagsterInstance, run: dg.DagsterRun, kind: dg.DagsterEventType) -> None:
    instance.report_dagster_event(dg.DagsterEvent(kind.value, run.job_name), run.run_id)


def fail(instance: dg.DagsterInstance, run: dg.DagsterRun) -> None:
    instance.report_run_failed(run, "no memory")


def cancel(instance: dg.DagsterInstance, run: dg.DagsterRun) -> None:
    instance.report_run_canceled(run, "canceled by hand")


def retry(instance: dg.DagsterInstance, run: dg.DagsterRun) -> None:
    """Fail, and succeed in a run that Dagster starts instead."""
    again = instance.create_run_for_job(no_work)
    succeed(instance, again)
    instance.add_run_tags(run.run_id, {AUTO_RETRY_RUN_ID_TAG: again.run_id})
    fail(instance, run)


@pytest.mark.parametrize(("tags", "is_failed"), [(NIGHT, True), (BY_PEOPLE, False)])
def test_only_orphaned_runs_are_failed(runner, tags, is_failed):
    run = runner.instance.create_run_for_job(no_work, tags=tags)
    start(runner.instance, run)

    runner.fail_orphaned_runs()

    assert runner.instance.get_run_by_id(run.run_id).is_failure == is_failed


def test_orphaned_remote_runs_are_awaited(runner, monkeypatch):
    answers = iter([True, True, False])
    waits = []
    monkeypatch.setattr(runs, "daemon_answers", lambda instance: True)
    monkeypatch.setattr(runs, "is_active", lambda instance, tags: next(answers))
    monkeypatch.setattr(runs.time, "sleep", waits.append)

    RemoteExecutor(runner).settle()

    assert waits == [runs.LOOK_S, runs.LOOK_S]


@pytest.mark.parametrize(("tags", "is_canceled"), [(NIGHT, True), (BY_PEOPLE, False)])
def test_only_unsent_runs_of_nights_are_canceled(runner, monkeypatch, tags, is_canceled):
    monkeypatch.setattr(runs, "daemon_answers", lambda instance: True)
    run = runner.instance.create_run_for_job(no_work, tags=tags)

    RemoteExecutor(runner).settle()

    status = runner.instance.get_run_by_id(run.run_id).status
    assert (status == dg.DagsterRunStatus.CANCELED) == is_canceled


def test_night_needs_the_daemon(runner, monkeypatch):
    monkeypatch.setattr(runs, "daemon_answers", lambda instance: False)

    with pytest.raises(EngineError, match="no Dagster daemon answers"):
        RemoteExecutor(runner).settle()


@pytest.fixture
def send_out(instance, monkeypatch) -> Callable[..., list[BatchResult]]:
    """Make batches elsewhere, where runs end one after the other as given, and the rest well."""

    def make(batches: list[PartitionBatch], *endings: Callable[..., None]) -> list[BatchResult]:
        ends = iter(endings)

        def submit(instance: dg.DagsterInstance, run: dg.DagsterRun) -> None:
            end = next(ends, succeed)
            end(instance, run)

        monkeypatch.setattr(runs, "submit", submit)
        monkeypatch.setattr(runs.time, "sleep", lambda seconds: None)
        executor = RemoteExecutor(Elsewhere(dg.Definitions(), instance, None, {}))
        return list(executor.make([], batches, "legs"))

    return make


def test_retry_stands_for_its_run(send_out):
    assert send_out([ONE], retry) == [BatchResult(1, 1)]


@pytest.mark.parametrize(("end", "reason"), [(fail, "no memory"), (cancel, "canceled by hand")])
def test_unfinished_run_is_a_failure(send_out, end, reason):
    (result,) = send_out([ONE], end)

    assert list(result.failed) == ["legs: AAA:T1"]
    assert reason in result.failed["legs: AAA:T1"]


def test_aircraft_of_a_failed_run_are_made_alone(send_out):
    results = send_out([TWO], fail)

    assert [result.failed for result in results] == [{}] * 3
    (line,) = results[0].repairs
    assert line == "legs: a run of 2 aircraft stopped, so each was made alone; report it: no memory"


def test_cells_of_a_split_run_count_once(send_out):
    assert sum(result.cells for result in send_out([TWO], fail)) == 2


def test_queue_is_kept_short(instance, monkeypatch):
    monkeypatch.setattr(runs, "AHEAD", 2)
    queue = []
    lengths = []

    def look(seconds: float) -> None:
        lengths.append(len(queue))
        while queue:
            succeed(instance, queue.pop())

    monkeypatch.setattr(runs, "submit", lambda instance, run: queue.append(run))
    monkeypatch.setattr(runs.time, "sleep", look)
    list(RemoteExecutor(Elsewhere(dg.Definitions(), instance, None, {})).make([], [ONE] * 3, "legs"))

    assert max(lengths) == 2


def register(runner: Runner, *cells: tuple[str, str, str]) -> None:
    runner.register(pl.DataFrame(cells, schema=["operator", "tail", "flight_id"], orient="row"))


def test_flights_are_registered_by_departure(runner):
    days = [f"202601{day:02d}_01" for day in range(1, 9)]

    register(runner, *(("AAA", "T1", f"T1_{day}") for day in reversed(days)))

    assert runner.instance.get_dynamic_partitions("flight") == days


def test_aircraft_alone_registers_no_flight(runner):
    register(runner, ("AAA", "T1", ""))

    assert runner.instance.get_dynamic_partitions("flight") == []


@pytest.mark.parametrize(("hour", "day"), [(11, "2026-01-01"), (12, "2026-01-02")])
def test_night_is_named_by_its_first_day(runner, monkeypatch, hour, day):
    class Clock:
        @staticmethod
        def now(zone):
            return datetime(2026, 1, 2, hour, tzinfo=UTC)

    monkeypatch.setattr(runs, "datetime", Clock)

    assert runner.create(no_work, ONE, "legs").tags["hdt/step"] == f"{day} legs"


class Files:
    """A ledger of three files with two flights."""

    def of(self, aircraft):
        return self

    def flight_files(self):
        paths = {"T1_20260101_01": ("c.csv", "b.csv"), "T1_20260101_02": ("a.csv",)}
        rows = [(flight, name) for flight, names in paths.items() for name in names]
        return pl.DataFrame(rows, schema=["flight_id", "path"], orient="row")


@pytest.mark.parametrize(
    ("first", "last", "words"),
    [
        ("20260101_01", "20260101_01", "T1_20260101_01 (b.csv, c.csv)"),
        ("20260101_01", "20260101_02", "flights 20260101_01 to 20260101_02"),
        ("", "", ""),
    ],
    ids=["one", "several", "above flights"],
)
def test_failed_flights_are_named(first, last, words):
    batch = PartitionBatch((("AAA:T1", first),), (first, last))

    assert Runner(None, None, Files(), {})._describe_flights(batch) == words
