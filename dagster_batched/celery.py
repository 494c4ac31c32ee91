"""Launch Dagster runs on several machines by Celery, and detect lost ones.

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
    "task_ignore_result": True,  # Dagster's own storage has the result
    "task_publish_retry_policy": {"max_retries": 150, "interval_start": 0.2, "interval_step": 0.2, "interval_max": 2.0},
    "broker_transport_options": {"confirm_publish": True},  # a broker that dies with a message is noticed
    "broker_connection_retry_on_startup": True,
    "broker_connection_max_retries": None,
    "worker_cancel_long_running_tasks_on_connection_loss": False,
    # Messages are acknowledged when accepted. A late acknowledgement would deliver a lost run again, which Dagster,
    # where the run is started, would ignore and report as done.
    "task_acks_late": False,
}


class WatchedCeleryRunLauncher(CeleryRunLauncher):
    """Celery's launcher with detection of lost runs by the workers' lists of active tasks.

    Stock reads the result backend, where a dead worker's run stays STARTED for ever.
    """

    def __init__(self, grace_s: int = 60, **settings: Any) -> None:
        self.grace_s = grace_s
        own = SETTINGS | (settings.pop("config_source", None) or {})
        super().__init__(**settings, config_source=own)
        self._active_tasks: tuple[float, set[str] | None] = 0.0, None
        self._missing_since: dict[str, float] = {}

    @classmethod
    def config_type(cls) -> Mapping[str, Any]:
        """Return stock's settings and `grace_s`."""
        note = "Seconds a run may be missing; a worker that lost the broker is back in half a minute, its run goes on."
        stock: Any = super().config_type()
        return {**stock, "grace_s": Field(IntSource, default_value=60, description=note)}

    @classmethod
    def from_config_value(cls, inst_data: ConfigurableClassData, config_value: Mapping[str, Any]) -> Self:
        """Build from `dagster.yaml`, without a result backend, which is not used."""
        return cls(inst_data=inst_data, **{**config_value, "backend": None})

    def check_run_worker_health(self, run: DagsterRun) -> CheckRunHealthResult:
        """Report a run as lost that no worker has had for `grace_s`, while workers answer.

        While none answers the broker may be down and its workers intact, and without workers there is none to retry on.
        """
        task = run.tags.get(DAGSTER_CELERY_TASK_ID_TAG)
        tasks = self._tasks()
        if task is None or tasks is None or task in tasks:  # a run without a task was never launched
            self._missing_since.pop(run.run_id, None)
            return CheckRunHealthResult(WorkerStatus.RUNNING)
        missing_s = time.monotonic() - self._missing_since.setdefault(run.run_id, time.monotonic())
        if missing_s < self.grace_s:
            return CheckRunHealthResult(WorkerStatus.RUNNING)
        return CheckRunHealthResult(WorkerStatus.NOT_FOUND, f"no worker has been at it for {missing_s:.0f} s")

    def get_run_worker_debug_info(self, run: DagsterRun, include_container_logs: bool | None = True) -> str:
        """Describe a lost run for the daemon's message; stock reads the result backend, and there is none."""
        task = run.tags.get(DAGSTER_CELERY_TASK_ID_TAG)
        tasks = self._tasks()
        state = "no worker answers" if tasks is None else f"workers are at {len(tasks)} tasks"
        return f"Celery task {task}; {state}, {'this one' if task in (tasks or ()) else 'not this one'}"

    def _tasks(self) -> set[str] | None:
        """List the workers' active tasks; None where no worker answers."""
        at, tasks = self._active_tasks
        if time.monotonic() - at > _FRESH_S:
            try:
                answers = self.celery.control.inspect(timeout=_ANSWER_S).active()
            except (OperationalError, OSError):
                answers = None
            tasks = {task["id"] for active in answers.values() for task in active} if answers else None
            self._active_tasks = time.monotonic(), tasks
        return tasks


def worker(broker: str) -> Celery:
    """Build the Celery application of a worker machine, which executes Dagster's runs."""
    app: Celery = WatchedCeleryRunLauncher(default_queue="dagster", broker=broker).celery
    create_execute_job_task(app)
    return app
