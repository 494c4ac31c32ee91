"""A run in this process: its range, how it is made, whether someone ended it."""

from collections.abc import Iterable

import dagster as dg
from dagster._core.definitions.job_base import InMemoryJob
from dagster._core.errors import DagsterExecutionInterruptedError
from dagster._core.events import RunFailureReason
from dagster._core.execution.api import execute_run
from dagster._core.storage.tags import ASSET_PARTITION_RANGE_END_TAG, ASSET_PARTITION_RANGE_START_TAG

InterruptedRunError = DagsterExecutionInterruptedError


def range_tags(first: str, last: str) -> dict[str, str]:
    """Tags of a run over the partitions from `first` to `last`."""
    return {ASSET_PARTITION_RANGE_START_TAG: first, ASSET_PARTITION_RANGE_END_TAG: last}


def execute(job: dg.JobDefinition, run: dg.DagsterRun, instance: dg.DagsterInstance) -> dg.JobExecutionResult:
    """Make a run that was created, here and now; what fails is told by the result."""
    return execute_run(InMemoryJob(job), run, instance, raise_on_error=False)


def was_interrupted(events: Iterable[dg.DagsterEvent]) -> bool:
    """Whether someone ended the run; Dagster calls it a failure of the run, and what follows would go on."""
    failed = (e for e in events if e.event_type == dg.DagsterEventType.RUN_FAILURE)
    return any(e.job_failure_data.failure_reason == RunFailureReason.UNEXPECTED_TERMINATION for e in failed)


def failure_of(events: Iterable[dg.DagsterEvent]) -> str | None:
    """The innermost error of the first step that failed, in one line."""
    for event in events:
        error = event.step_failure_data.error if event.is_step_failure else None
        while error is not None and error.cause is not None:
            error = error.cause
        if error is not None:
            return str(error.message).strip().splitlines()[0].removeprefix("dagster._core.definitions.events.Failure: ")
    return None
