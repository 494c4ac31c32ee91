"""What a worker machine starts: `celery --app pipelines.celery_worker worker --concurrency 1`.

HDT_BROKER_URL names the broker, DAGSTER_HOME the folder with the fleet's `dagster.yaml`. Nothing heavy is loaded here:
runs are made in forked processes, and what Polars starts does not survive a fork.
"""

import os

from dagster_celery.tasks import create_execute_job_task

from dagster_batched.celery import WatchedCeleryRunLauncher

app = WatchedCeleryRunLauncher(default_queue="dagster", broker=os.environ["HDT_BROKER_URL"]).celery
execute_job = create_execute_job_task(app)
