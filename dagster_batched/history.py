"""Dagster's history grows with every cell; what is stored and what is stale are in the ledger and need none of it."""

from datetime import datetime
from pathlib import Path

import dagster as dg
from dagster._core.storage.dagster_run import FINISHED_STATUSES

from dagster_batched.event_log import BatchedSqliteEventLogStorage


def forget(instance: dg.DagsterInstance, before: datetime) -> int:
    """Remove runs that ended before a moment, with their events; how many there were.

    Cells that no later run made show as not materialized from then on.
    """
    ended = dg.RunsFilter(statuses=list(FINISHED_STATUSES), updated_before=before)
    runs = instance.get_runs(ended)
    log = instance.event_log_storage
    for run in runs:
        instance.delete_run(run.run_id)
        if isinstance(log, BatchedSqliteEventLogStorage):
            _remove(Path(log.path_for_shard(run.run_id)))
    return len(runs)


def _remove(shard: Path) -> None:
    """A run's own file, and what SQLite keeps beside it."""
    for end in ("", "-wal", "-shm"):
        shard.with_name(shard.name + end).unlink(missing_ok=True)
