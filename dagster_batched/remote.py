"""A run that the instance's own launcher sends to another machine: where its code is, and what became of it."""

import sys
from collections.abc import Collection
from typing import Any

import dagster as dg
from dagster._core.code_pointer import ModuleCodePointer
from dagster._core.origin import DEFAULT_DAGSTER_ENTRY_POINT, JobPythonOrigin, RepositoryPythonOrigin
from dagster._core.remote_origin import ManagedGrpcPythonEnvCodeLocationOrigin, RemoteJobOrigin, RemoteRepositoryOrigin
from dagster._core.storage.dagster_run import FINISHED_STATUSES
from dagster._core.storage.tags import AUTO_RETRY_RUN_ID_TAG, WILL_RETRY_TAG
from dagster._core.types.loadable_target_origin import LoadableTargetOrigin
from dagster._daemon.controller import all_daemons_live

_SILENT_S = 60  # beyond the half minute between two of the daemon's heartbeats
_UNDER_WAY = [dg.DagsterRunStatus[s] for s in ("QUEUED", "STARTING", "STARTED", "CANCELING")]


def daemon_answers(instance: dg.DagsterInstance) -> bool:
    """Whether Dagster's daemon, which hands runs out, is alive."""
    return all_daemons_live(instance, heartbeat_tolerance_seconds=_SILENT_S)


def origins(job: dg.JobDefinition, module: str) -> dict[str, Any]:
    """Where another process finds the job: what `create_run_for_job` takes beside it. `module` holds `defs`."""
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
    """Hand a run to the instance's coordinator."""
    instance.submit_run(run.run_id, None)  # type: ignore[arg-type]  # a workspace only launchers by gRPC ask for


def ended(instance: dg.DagsterInstance, run_ids: Collection[str]) -> list[dg.DagsterRun]:
    """Of some runs those that have ended, for good or with another that takes their place (`successor`)."""
    runs = instance.get_runs(dg.RunsFilter(run_ids=list(run_ids), statuses=FINISHED_STATUSES))
    return [run for run in runs if not _in_doubt(instance, run)]


def successor(run: dg.DagsterRun) -> str | None:
    """Id of the run that Dagster started in place of one that failed."""
    return None if run.is_success else run.tags.get(AUTO_RETRY_RUN_ID_TAG)


def under_way(instance: dg.DagsterInstance, tags: dict[str, str]) -> bool:
    """Whether a run of these tags may still write."""
    lost = dg.RunsFilter(statuses=[dg.DagsterRunStatus.FAILURE], tags=tags | {WILL_RETRY_TAG: "true"})
    going = instance.get_runs(dg.RunsFilter(statuses=_UNDER_WAY, tags=tags), limit=1)
    return bool(going) or any(_in_doubt(instance, run) for run in instance.get_runs(lost))


def _in_doubt(instance: dg.DagsterInstance, run: dg.DagsterRun) -> bool:
    """Whether it failed and Dagster is yet to say if it starts again, or to start it."""
    if run.status != dg.DagsterRunStatus.FAILURE or not instance.run_retries_enabled:
        return False
    return run.tags.get(WILL_RETRY_TAG, "true") == "true" and AUTO_RETRY_RUN_ID_TAG not in run.tags
