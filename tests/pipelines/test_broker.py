"""A run is lost when workers answer and none of them is at it, and not before."""

import dagster as dg
import pytest
from dagster._core.launcher import WorkerStatus

from dagster_batched import celery

AT_WORK = {"one@a": [{"id": "task-1"}], "two@b": []}
RUNNING = WorkerStatus.RUNNING
NOT_FOUND = WorkerStatus.NOT_FOUND
BEGUN_ANEW = ((AT_WORK, 100, RUNNING), (AT_WORK, 61, NOT_FOUND))
NOBODY = (None, celery.OperationalError("refused"), ConnectionResetError())


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


@pytest.mark.parametrize(
    ("task", "looks"),
    [
        ("task-1", [(AT_WORK, 0, RUNNING)]),
        ("task-2", [(AT_WORK, 0, RUNNING), (AT_WORK, 59, RUNNING), (AT_WORK, 2, NOT_FOUND)]),
        *(("task-2", [(AT_WORK, 0, RUNNING), (nobody, 100, RUNNING), *BEGUN_ANEW]) for nobody in NOBODY),
        (None, [(AT_WORK, 100, RUNNING)] * 3),
    ],
)
def test_run_without_worker_is_lost(watched_launcher, task, looks):
    """After a while in which workers answer; a run that was never sent out is not theirs."""
    launcher, workers = watched_launcher
    run = run_of(task)
    for answer, later_s, status in looks:
        workers |= {"answer": answer, "now": workers["now"] + later_s}
        health = launcher.check_run_worker_health(run)
        assert health.status == status
    assert health.msg == ("no worker has been at it for 61 s" if status == NOT_FOUND else None)


def test_one_look_asks_workers_once(watched_launcher):
    launcher, workers = watched_launcher
    for answer in (AT_WORK, RuntimeError("asked again")):
        workers["answer"] = answer
        assert launcher.check_run_worker_health(run_of("task-1")).status == RUNNING


def test_task_is_acknowledged_when_begun(watched_launcher):
    """And asks for no result."""
    launcher, _ = watched_launcher
    conf = launcher.celery.conf
    assert (conf.task_acks_late, conf.task_ignore_result, conf.result_backend) == (False, True, None)
    assert conf.worker_prefetch_multiplier == 1
