"""Where a site's `dagster.yaml` of before names its launcher; new ones name `dagster_batched.celery`."""

from dagster_batched.celery import WatchedCeleryRunLauncher

__all__ = ["WatchedCeleryRunLauncher"]
