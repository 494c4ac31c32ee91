"""Open an instance with a batched event log, execute runs here or on other machines, report what they have made."""

import math
import os
import sys
import uuid
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import dagster as dg
import yaml
from dagster._core.code_pointer import ModuleCodePointer
from dagster._core.definitions.job_base import InMemoryJob
from dagster._core.definitions.partitions.subset import DefaultPartitionsSubset
from dagster._core.errors import DagsterExecutionInterruptedError
from dagster._core.events import DagsterEvent, DagsterEventBatchMetadata, RunFailureReason, StepMaterializationData
from dagster._core.execution.api import execute_run
from dagster._core.instance.utils import RUNLESS_JOB_NAME, RUNLESS_RUN_ID
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

from dagster_batched.event_log import CoalescingEventLog
from dagster_batched.partitions import make_keys_quickly, skip_input_versions

BATCH_EVENTS = 1000

_SETTINGS = """\
{mark} {note}
telemetry:
  enabled: false
nux:
  enabled: false
freshness:
  enabled: true
compute_logs:  # the assets print nothing, and capturing output would start two processes a step
  module: dagster._core.storage.noop_compute_log_manager
  class: NoOpComputeLogManager
event_log_storage:
  module: dagster_batched.event_log
  class: BatchedSqliteEventLogStorage
  config:
    base_dir: {history}
retention:  # of what the daemon looked at; runs are another matter (`dagster_batched.history`)
  schedule: {{purge_after_days: {days}}}
  sensor: {{purge_after_days: {days}}}
  auto_materialize: {{purge_after_days: {days}}}
"""


def batch_events() -> None:
    """Have Dagster pass asset events in batches; a user's own setting stays."""
    os.environ.setdefault("DAGSTER_EVENT_BATCH_SIZE", str(BATCH_EVENTS))


def open_instance(base: Path, mark: str, note: str, history_days: int = 90) -> dg.DagsterInstance:
    """Open the instance of a folder; a `dagster.yaml` there that does not begin with `mark` is used unchanged.

    Parameters
    ----------
    base : Path
        Absolute folder; it is created where it is missing, and may have been moved.
    mark, note : str
        First line of the settings that are written here: by whom, and a note about them.
    history_days : int
        Days for which the daemon keeps what schedules and sensors did. [days]
    """
    batch_events()
    skip_input_versions()
    make_keys_quickly()
    base.mkdir(parents=True, exist_ok=True)
    history = yaml.safe_dump(f"{base}/history", default_style='"', width=math.inf).rstrip()
    settings = base / "dagster.yaml"
    ours = _SETTINGS.format(history=history, mark=mark, note=note, days=history_days)
    written = settings.read_text() if settings.exists() else ""
    if written != ours and (written.startswith(mark) or not written):  # a kill of an older version left it empty
        _replace_text(settings, ours)
    instance = dg.DagsterInstance.from_config(str(base))
    if instance.telemetry_enabled and settings.read_text() == ours:
        raise ValueError(f"Dagster did not read {settings}")
    return instance


def _replace_text(path: Path, text: str) -> None:
    """Replace a file at once: a process that read it half written would use Dagster's slow event log for its life."""
    copy = path.with_name(f".{path.name}.{os.getpid()}")
    copy.write_text(text)
    copy.replace(path)


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
    from dagster._daemon.controller import all_daemons_live  # noqa: PLC0415 (only runs sent elsewhere need it)

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
    return [run for run in runs if not may_retry(instance, run)]


def successor(run: dg.DagsterRun) -> str | None:
    """Return the id of the run that Dagster started in place of a failed one."""
    return None if run.is_success else run.tags.get(AUTO_RETRY_RUN_ID_TAG)


def is_active(instance: dg.DagsterInstance, tags: dict[str, str]) -> bool:
    """Return whether a run with these tags may still write."""
    retrying = dg.RunsFilter(statuses=[dg.DagsterRunStatus.FAILURE], tags=tags | {WILL_RETRY_TAG: "true"})
    active = instance.get_runs(dg.RunsFilter(statuses=_ACTIVE, tags=tags), limit=1)
    return bool(active) or any(may_retry(instance, run) for run in instance.get_runs(retrying))


def may_retry(instance: dg.DagsterInstance, run: dg.DagsterRun) -> bool:
    """Return whether a failed run has a retry that Dagster has yet to decide on or to start."""
    if run.status != dg.DagsterRunStatus.FAILURE or not instance.run_retries_enabled:
        return False
    return run.tags.get(WILL_RETRY_TAG, "true") == "true" and AUTO_RETRY_RUN_ID_TAG not in run.tags


def report_partitions(
    context: dg.OutputContext, partitions: Sequence[str], numbers: Sequence[Mapping[str, int]] = ()
) -> None:
    """Report that an output filled these partitions and no others of its run's range.

    A range over two dimensions is their product, of which a run often fills a part. Dagster has no public way to list
    it; it reads the subset of the output's context. In an event log of this package one event covers all partitions; in
    any other each has its own.

    Parameters
    ----------
    context : OutputContext
        The context of `IOManager.handle_output`, of an asset with partitions.
    partitions : sequence of str
        Keys of the filled partitions, all of the run's range. With none the output counts for no partition.
    numbers : sequence of mapping
        Metadata of each partition's event beside the output's. In a log of Dagster's own all events of an output have
        the same metadata, so these are added only where there is one.
    """
    log = context.step_context.instance.event_log_storage
    if numbers and (isinstance(log, CoalescingEventLog) or len(partitions) == 1):
        context.add_output_metadata(numbers[0])
    if isinstance(log, CoalescingEventLog) and partitions:
        log.group_partitions(context.run_id, context.asset_key, partitions, numbers)
        partitions = partitions[:1]
    context._asset_partitions_subset = DefaultPartitionsSubset(set(partitions))


def report_runless(instance: dg.DagsterInstance, materializations: Sequence[dg.AssetMaterialization]) -> None:
    """Record materializations that belong to no run in one transaction; stock has them one by one."""
    batch = str(uuid.uuid4())
    for last, materialization in zip([*[False] * (len(materializations) - 1), True], materializations, strict=True):
        event = DagsterEvent(
            dg.DagsterEventType.ASSET_MATERIALIZATION.value,
            job_name=RUNLESS_JOB_NAME,
            event_specific_data=StepMaterializationData(materialization),
        )
        instance.report_dagster_event(event, RUNLESS_RUN_ID, batch_metadata=DagsterEventBatchMetadata(batch, last))


class CheckBeforeStorage(dg.AssetCheckResult):
    """A check's result that belongs to the output after it.

    Dagster would look up the previous materialization of every table.
    """

    def _get_target_materialization_data(self, *_: Any) -> None:
        return None
