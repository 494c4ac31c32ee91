"""Where a home's `dagster.yaml` of before names its event log; new ones name `dagster_batched.event_log`."""

from dagster_batched.event_log import BatchedSqliteEventLogStorage

__all__ = ["BatchedSqliteEventLogStorage"]
