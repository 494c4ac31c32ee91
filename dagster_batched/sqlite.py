"""Where settings of before name the event log in SQLite; new ones name `dagster_batched.event_log`."""

from dagster_batched.event_log import BatchedSqliteEventLogStorage

__all__ = ["BatchedSqliteEventLogStorage"]
