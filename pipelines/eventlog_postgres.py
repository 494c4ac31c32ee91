"""Where a site's `dagster.yaml` of before names its event log; new ones name `dagster_batched.postgres`."""

from dagster_batched.postgres import BatchedPostgresEventLogStorage

__all__ = ["BatchedPostgresEventLogStorage"]
