"""Which partitions of a run's range an output has filled; and assets that were made outside of any run."""

import uuid
from collections.abc import Mapping, Sequence

import dagster as dg
from dagster._core.definitions.partitions.subset import DefaultPartitionsSubset
from dagster._core.events import DagsterEvent, DagsterEventBatchMetadata, StepMaterializationData
from dagster._core.instance.utils import RUNLESS_JOB_NAME, RUNLESS_RUN_ID

from dagster_batched.coalescing import CoalescingEventLog


def report_partitions(
    context: dg.OutputContext, partitions: Sequence[str], numbers: Sequence[Mapping[str, int]] = ()
) -> None:
    """Let an output count for these partitions and for no others of its run's range.

    A range over two dimensions is their product, of which a run often fills a part. Dagster has no public way to say
    which; the subset of the output's context is where it looks. Where the instance's event log is one of this package,
    one event stands for all the partitions; in any other each has its own.

    Parameters
    ----------
    context : OutputContext
        What `IOManager.handle_output` was called with, of an asset with partitions.
    partitions : sequence of str
        Keys of the partitions that were filled, all of the run's range. With none the output counts for no partition.
    numbers : sequence of mapping
        What the event of each tells as metadata, beside what the output tells of all of them. In a log of Dagster's own
        all events of an output tell the same, so these are told only where there is one.
    """
    log = context.step_context.instance.event_log_storage
    if numbers and (isinstance(log, CoalescingEventLog) or len(partitions) == 1):
        context.add_output_metadata(numbers[0])
    if isinstance(log, CoalescingEventLog) and partitions:
        log.represents(context.run_id, context.asset_key, partitions, numbers)
        partitions = partitions[:1]
    context._asset_partitions_subset = DefaultPartitionsSubset(set(partitions))


def report_runless(instance: dg.DagsterInstance, made: Sequence[dg.AssetMaterialization]) -> None:
    """Record materializations that belong to no run in one transaction; stock has them one by one."""
    batch = str(uuid.uuid4())
    for last, materialization in zip([*[False] * (len(made) - 1), True], made, strict=True):
        event = DagsterEvent(
            dg.DagsterEventType.ASSET_MATERIALIZATION.value,
            job_name=RUNLESS_JOB_NAME,
            event_specific_data=StepMaterializationData(materialization),
        )
        instance.report_dagster_event(event, RUNLESS_RUN_ID, batch_metadata=DagsterEventBatchMetadata(batch, last))
