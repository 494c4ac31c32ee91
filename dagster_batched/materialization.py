"""Which partitions of a run's range an output has filled."""

from collections.abc import Mapping, Sequence

import dagster as dg
from dagster._core.definitions.partitions.subset import DefaultPartitionsSubset

from dagster_batched.event_log import CoalescingEventLog


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
        What the event of each tells as metadata where one event stands for all: the first, with the run's numbers, does
        not.
    """
    log = context.step_context.instance.event_log_storage
    if isinstance(log, CoalescingEventLog) and partitions:
        log.represents(context.run_id, context.asset_key, partitions, numbers)
        partitions = partitions[:1]
    context._asset_partitions_subset = DefaultPartitionsSubset(set(partitions))
