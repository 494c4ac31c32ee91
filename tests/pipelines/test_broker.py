"""A run is lost when workers answer and none of them is at it, and not before."""

import dagster as dg
import pytest
from dagster._core.launcher import WorkerStatus

from dagster_batched import celery

AT_WORK = {"one@a": [{"id": "task-1"}], "two@b": []}


@pytest.fixture
def watched_launcher(monkeypatch):
    """A launcher, what its workers answer, and the time."""
    launcher = celery.WatchedCeleryRunLauncher(default_queue="dagster", broker="memory://", grace_s=60)
    workers = {"answer": AT_WORK, "now": 1000.0}

    class Inspect:
        def __init__(self, timeout: float) -> None: ...

        def active(self):
            if isinstance(workers["answer"], Exception):
                raise workers["answer"]
            return workers["answer"]

    monkeypatch.setattr(launcher.celery.control, "inspect", Inspect)
    monkeypatch.setattr(celery.time, "monotonic", lambda: workers["now"])
    return launcher, workers


def run_of(task: str | None) -> dg.DagsterRun:
    return dg.DagsterRun(job_name="any", tags={"dagster-celery/task_id": task} if task else {})


def status(launcher, run):
    return launcher.check_run_worker_health(run).status


def test_a_run_that_a_worker_is_at_lives(watched_launcher):
    launcher, _ = watched_launcher
    assert status(launcher, run_of("task-1")) == WorkerStatus.RUNNING


def test_a_run_that_nobody_is_at_is_lost_after_a_while(watched_launcher):
    launcher, workers = watched_launcher
    run = run_of("task-2")
    assert status(launcher, run) == WorkerStatus.RUNNING
    workers["now"] += 59
    assert status(launcher, run) == WorkerStatus.RUNNING
    workers["now"] += 2
    health = launcher.check_run_worker_health(run)
    assert health.status == WorkerStatus.NOT_FOUND
    assert health.msg == "no worker has been at it for 61 s"


@pytest.mark.parametrize("silence", [None, celery.OperationalError("refused"), ConnectionResetError()])
def test_while_nobody_answers_nothing_is_lost_and_the_while_begins_anew(watched_launcher, silence):
    launcher, workers = watched_launcher
    run = run_of("task-2")
    assert status(launcher, run) == WorkerStatus.RUNNING
    workers |= {"answer": silence, "now": workers["now"] + 100}
    assert status(launcher, run) == WorkerStatus.RUNNING
    workers |= {"answer": AT_WORK, "now": workers["now"] + 100}
    assert status(launcher, run) == WorkerStatus.RUNNING
    workers["now"] += 61
    assert status(launcher, run) == WorkerStatus.NOT_FOUND


def test_workers_are_asked_once_for_all_runs_of_a_look(watched_launcher):
    launcher, workers = watched_launcher
    status(launcher, run_of("task-1"))
    workers["answer"] = RuntimeError("asked again")
    assert status(launcher, run_of("task-1")) == WorkerStatus.RUNNING


def test_a_run_that_was_never_sent_out_is_not_the_workers(watched_launcher):
    launcher, workers = watched_launcher
    run = run_of(None)
    for _ in range(3):
        workers["now"] += 100
        assert status(launcher, run) == WorkerStatus.RUNNING


def test_what_is_sent_is_acknowledged_when_it_begins_and_asks_for_no_result(watched_launcher):
    launcher, _ = watched_launcher
    conf = launcher.celery.conf
    assert (conf.task_acks_late, conf.task_ignore_result, conf.result_backend) == (False, True, None)
    assert conf.worker_prefetch_multiplier == 1
