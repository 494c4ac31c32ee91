"""What a worker machine starts: `celery --app pipelines.celery_worker worker --concurrency 1`.

HDT_BROKER_URL names the broker, DAGSTER_HOME the folder with the fleet's `dagster.yaml`. Nothing heavy is loaded here:
runs are made in forked processes, and what Polars starts does not survive a fork.
"""

import os

from dagster_batched.celery import worker

app = worker(os.environ["HDT_BROKER_URL"])
