"""Execute runs in this process, and follow runs that the instance's launcher sends to other machines."""

import sys
from collections.abc import Collection, Iterable
from typing import Any

import dagster as dg
from dagster._core.code_pointer import ModuleCodePointer
from dagster._core.definitions.job_base import InMemoryJob
from dagster._core.errors import DagsterExecutionInterruptedError
from dagster._core.events import RunFailureReason
from dagster._core.execution.api import execute_run
from dagster._core.origin import DEFAULT_DAGSTER_ENTRY_POINT, JobPythonOrigin, RepositoryPythonOrigin
from dagster._core.remote_origin import ManagedGrpcPythonEnvCodeLocationOrigin, RemoteJobOrigin, RemoteRepositoryOrigin
from dagster._core.storage.dagster_run import FINISHED_STATUSES
from dagster._core.storage.tags import (
    ASSET_PARTITION_RANGE_END_TAG,
    ASSET_PARTITION_RANGE_START_TAG,
    AUTO_RETRY_RUN_ID_TAG,
    WILL_RETRY_TAG,
)
from dagster._core.types.loadable_target_origin import LoadableTargetOrigin
from dagster._daemon.controller import all_daemons_live

InterruptedRunError = DagsterExecutionInterruptedError
_SILENT_S = 60  # beyond the half minute between two of the daemon's heartbeats
_ACTIVE = [dg.DagsterRunStatus[s] for s in ("QUEUED", "STARTING", "STARTED", "CANCELING")]


def range_tags(first: str, last: str) -> dict[str, str]:
    """Build the tags of a run over the partitions from `first` to `last`."""
    return {ASSET_PARTITION_RANGE_START_TAG: first, ASSET_PARTITION_RANGE_END_TAG: last}


def execute(job: dg.JobDefinition, run: dg.DagsterRun, instance: dg.DagsterInstance) -> dg.JobExecutionResult:
    """Execute a run in this process; the result reports failures."""
    return execute_run(InMemoryJob(job), run, instance, raise_on_error=False)


def was_interrupted(events: Iterable[dg.DagsterEvent]) -> bool:
    """Return whether someone ended the run; Dagster reports it as a failure, after which other runs would go on."""
    failures = (e for e in events if e.event_type == dg.DagsterEventType.RUN_FAILURE)
    return any(e.job_failure_data.failure_reason == RunFailureReason.UNEXPECTED_TERMINATION for e in failures)


def failure_of(events: Iterable[dg.DagsterEvent]) -> str | None:
    """Find the innermost error of the first failed step, in one line."""
    for event in events:
        error = event.step_failure_data.error if event.is_step_failure else None
        while error is not None and error.cause is not None:
            error = error.cause
        if error is not None:
            return str(error.message).strip().splitlines()[0].removeprefix("dagster._core.definitions.events.Failure: ")
    return None


def daemon_answers(instance: dg.DagsterInstance) -> bool:
    """Return whether Dagster's daemon, which launches queued runs, is alive."""
    return all_daemons_live(instance, heartbeat_tolerance_seconds=_SILENT_S)


def origins(job: dg.JobDefinition, module: str) -> dict[str, Any]:
    """Build the origins of a job for `create_run_for_job`, by which another process finds it; `module` has `defs`."""
    target = LoadableTargetOrigin(executable_path=sys.executable, module_name=module)
    location = ManagedGrpcPythonEnvCodeLocationOrigin(target, module)
    code = RepositoryPythonOrigin(
        sys.executable, ModuleCodePointer(module, "defs", None), entry_point=DEFAULT_DAGSTER_ENTRY_POINT
    )
    return {
        "remote_job_origin": RemoteJobOrigin(RemoteRepositoryOrigin(location, "__repository__"), job.name),
        "job_code_origin": JobPythonOrigin(job.name, code),
    }


def submit(instance: dg.DagsterInstance, run: dg.DagsterRun) -> None:
    """Submit a run to the instance's coordinator."""
    instance.submit_run(run.run_id, None)  # type: ignore[arg-type]  # only launchers by gRPC need a workspace


def finished_runs(instance: dg.DagsterInstance, run_ids: Collection[str]) -> list[dg.DagsterRun]:
    """Select runs that have finished, for good or with a retry that replaces them (`successor`)."""
    runs = instance.get_runs(dg.RunsFilter(run_ids=list(run_ids), statuses=FINISHED_STATUSES))
    return [run for run in runs if not _may_retry(instance, run)]


def successor(run: dg.DagsterRun) -> str | None:
    """Return the id of the run that Dagster started in place of a failed one."""
    return None if run.is_success else run.tags.get(AUTO_RETRY_RUN_ID_TAG)


def is_active(instance: dg.DagsterInstance, tags: dict[str, str]) -> bool:
    """Return whether a run with these tags may still write."""
    retrying = dg.RunsFilter(statuses=[dg.DagsterRunStatus.FAILURE], tags=tags | {WILL_RETRY_TAG: "true"})
    active = instance.get_runs(dg.RunsFilter(statuses=_ACTIVE, tags=tags), limit=1)
    return bool(active) or any(_may_retry(instance, run) for run in instance.get_runs(retrying))


def _may_retry(instance: dg.DagsterInstance, run: dg.DagsterRun) -> bool:
    """Return whether a failed run has a retry that Dagster has yet to decide on or to start."""
    if run.status != dg.DagsterRunStatus.FAILURE or not instance.run_retries_enabled:
        return False
    return run.tags.get(WILL_RETRY_TAG, "true") == "true" and AUTO_RETRY_RUN_ID_TAG not in run.tags
