"""Run Dagster over thousands of partitions at the cost of one: events in groups, ranges with fixed cells.

Stock Dagster makes, serialises and commits an event for every partition of a step, 19 to 59 s per 1,000 partitions
and asset in SQLite. Most of these events differ in nothing but the partition. Here

- an IO manager lists with `report_partitions` the partitions of a run's range that an output has filled;
- an event log, `dagster_batched.event_log.BatchedSqliteEventLogStorage` or
  `dagster_batched.postgres.BatchedPostgresEventLogStorage`, named in `dagster.yaml`, stores them as one group in one
  transaction. Tables and rows are those of stock, so stock Dagster reads them.

All use of Dagster's private API is in this package, so that a new minor version of Dagster affects only these modules
and their tests (`tests/pipelines/test_eventlog.py` compares the tables with stock's): beside the event logs
`partitions` (ranges and keys), `runs` (here and on other machines), `celery`, `webserver`.
"""

from dagster_batched.runs import report_partitions

__all__ = ["report_partitions"]
