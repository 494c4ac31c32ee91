"""Where a home's `dagster.yaml` of before names its event log; new ones name `dagster_batched.sqlite`."""

from dagster_batched.sqlite import BatchedSqliteEventLogStorage

__all__ = ["BatchedSqliteEventLogStorage"]
