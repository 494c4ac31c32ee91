"""Report the partitions that an output has filled, assets made outside of any run, and checks before storage."""

import uuid
from collections.abc import Mapping, Sequence
from typing import Any

import dagster as dg
from dagster._core.definitions.partitions.subset import DefaultPartitionsSubset
from dagster._core.events import DagsterEvent, DagsterEventBatchMetadata, StepMaterializationData
from dagster._core.instance.utils import RUNLESS_JOB_NAME, RUNLESS_RUN_ID

from dagster_batched.coalescing import CoalescingEventLog


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
