"""Dagster runs on several machines by Celery: the launcher that sends them out and finds out which were lost.

Named in `dagster.yaml` (deploy/celery.yaml); needs the extra `celery`.
"""

import time
from collections.abc import Mapping
from typing import Any, Self

from celery import Celery
from dagster import DagsterRun, Field, IntSource
from dagster._core.launcher import CheckRunHealthResult, WorkerStatus
from dagster._serdes import ConfigurableClassData
from dagster_celery.launcher import CeleryRunLauncher
from dagster_celery.tags import DAGSTER_CELERY_TASK_ID_TAG
from dagster_celery.tasks import create_execute_job_task
from kombu.exceptions import OperationalError

_ANSWER_S, _FRESH_S = 2.0, 5.0
SETTINGS = {
    "task_ignore_result": True,  # how a run ended, Dagster's own storage says
    "task_publish_retry_policy": {"max_retries": 150, "interval_start": 0.2, "interval_step": 0.2, "interval_max": 2.0},
    "broker_transport_options": {"confirm_publish": True},  # a broker that dies with a message says so
    "broker_connection_retry_on_startup": True,
    "broker_connection_max_retries": None,
    "worker_cancel_long_running_tasks_on_connection_loss": False,
    # Accepted is acknowledged. A late acknowledgement would deliver a lost run again, and Dagster, which has the run
    # as started, would ignore that one and call it done.
    "task_acks_late": False,
}


class WatchedCeleryRunLauncher(CeleryRunLauncher):
    """Celery's launcher, which knows a lost run by asking the workers what they are at.

    Stock asks the result backend, and what a dead worker wrote there stays STARTED for ever.
    """

    def __init__(self, grace_s: int = 60, **settings: Any) -> None:
        self.grace_s = grace_s
        own = SETTINGS | (settings.pop("config_source", None) or {})
        super().__init__(**settings, config_source=own)
        self._at_work: tuple[float, set[str] | None] = 0.0, None
        self._missed: dict[str, float] = {}

    @classmethod
    def config_type(cls) -> Mapping[str, Any]:
        """Stock's settings and `grace_s`."""
        says = "Seconds a run may be missed; a worker that lost the broker is back in half a minute, its run goes on."
        stock: Any = super().config_type()
        return {**stock, "grace_s": Field(IntSource, default_value=60, description=says)}

    @classmethod
    def from_config_value(cls, inst_data: ConfigurableClassData, config_value: Mapping[str, Any]) -> Self:
        """Built from `dagster.yaml`; without a result backend, which nothing here asks."""
        return cls(inst_data=inst_data, **{**config_value, "backend": None})

    def check_run_worker_health(self, run: DagsterRun) -> CheckRunHealthResult:
        """Lost is a run that no worker has been at for a while, where workers answer.

        While nobody answers the broker may be down and its workers well; and with no worker there is none to retry on.
        """
        task, tasks = run.tags.get(DAGSTER_CELERY_TASK_ID_TAG), self._tasks()
        if task is None or tasks is None or task in tasks:  # a run without a task was never sent out
            self._missed.pop(run.run_id, None)
            return CheckRunHealthResult(WorkerStatus.RUNNING)
        missed_s = time.monotonic() - self._missed.setdefault(run.run_id, time.monotonic())
        if missed_s < self.grace_s:
            return CheckRunHealthResult(WorkerStatus.RUNNING)
        return CheckRunHealthResult(WorkerStatus.NOT_FOUND, f"no worker has been at it for {missed_s:.0f} s")

    def get_run_worker_debug_info(self, run: DagsterRun, include_container_logs: bool | None = True) -> str:
        """What the daemon adds to its message about a lost run; stock asks the result backend, and there is none."""
        task, tasks = run.tags.get(DAGSTER_CELERY_TASK_ID_TAG), self._tasks()
        told = "no worker answers" if tasks is None else f"workers are at {len(tasks)} tasks"
        return f"Celery task {task}; {told}, {'this one' if task in (tasks or ()) else 'not this one'}"

    def _tasks(self) -> set[str] | None:
        """Ids of the tasks that workers are at; None where nobody answers."""
        asked, known = self._at_work
        if time.monotonic() - asked > _FRESH_S:
            try:
                told = self.celery.control.inspect(timeout=_ANSWER_S).active()
            except (OperationalError, OSError):
                told = None
            known = {task["id"] for tasks in told.values() for task in tasks} if told else None
            self._at_work = time.monotonic(), known
        return known


def worker(broker: str) -> Celery:
    """What a worker machine runs: a Celery application that makes runs of Dagster's."""
    app: Celery = WatchedCeleryRunLauncher(default_queue="dagster", broker=broker).celery
    create_execute_job_task(app)
    return app
